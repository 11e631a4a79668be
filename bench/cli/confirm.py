"""confirm: new readings with and without a model file; is its effect confirmed, changed or gone."""

from __future__ import annotations

from bench.base.computing import one_thread
from bench.cli import printing, progress
from bench.cli.options import JsonOption, app
from bench.cli.requested import requested
from bench.services.requests.evaluation import Confirm


@app.command(epilog="Example: bench confirm unit-18 --model runs/unit-17/diagnose-model.yaml")
@requested
def confirm(request: Confirm, json: JsonOption = None) -> int:
    """New readings with and without a model: how far it closes the gap; exit status 1 unless confirmed."""
    one_thread()
    from bench.services.confirmation import confirmation_of
    from bench.services.source import load_sources, reading

    printing.check_target(json)
    (source,) = load_sources(reading(request, request.source))
    printing.bench_files([source], json)
    with progress.shown():
        result = confirmation_of(source)
    printing.write_json([result.to_dict()], json)
    result.print_on(printing.console(json=json))
    return 0 if result.confirmed else 1
