"""chart, compare, learn, monitor, stability: evaluations of many measurements, or of a block at rest."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, command
from bench.services.errors import Refused
from bench.services.requests.evaluation import Chart, Compare, Learn, Monitor, Stability


@command("bench chart runs --bench my-bench.yaml --page chart.html")
def chart(
    request: Chart,
    json: JsonOption = None,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="Write the charts as one HTML page.")
    ] = None,
) -> int:
    """Draw the control charts of the check block (Shewhart, EWMA).

    Exit status 1 unless the last run is in control.
    """
    from bench.results.control_chart import render_chart
    from bench.services.check_block import charted

    found = charted(request)
    files = () if page is None else [("page", page, render_chart(found))]
    printing.told(found.result, json, found.print_on, files)
    return 0 if found.accepted else 1


@command("bench compare 2025.json 2026.json unit-17 --strict")
def compare(
    request: Compare,
    json: JsonOption = None,
    out: OutOption = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Do not accept a change that exceeds the uncertainty.")
    ] = False,
) -> int:
    """Compare calibrations of one block: E_n, a joint test, drift."""
    from bench.results.compare import print_compare
    from bench.services.history import compared

    found = compared(request)
    for source, taken in found.taken:
        printing.bench_file(taken.part(), json, source)
    files = () if out is None else found.files(out)
    printing.told(found.result, json, partial(print_compare, found.result), files)
    return 1 if strict and found.result.changed else 0


@command("bench learn unit-* --out learned.yaml --expires 180")
def learn(
    request: Learn,
    json: JsonOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Learned file to write (default: learned.yaml)."),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="A run that contradicts the others is not accepted.")
    ] = False,
) -> int:
    """Estimate the errors of a bench from many runs, for its bench file."""
    from bench.services.history import learning_of
    from bench.services.source import load_sources, reading

    target = out or Path("learned.yaml")
    if target.exists():
        raise Refused(f"{target}: exists, and a learned file is not overwritten; name another with --out")
    sources = load_sources(reading(request, *request.sources))
    printing.bench_files(sources, json)
    found = learning_of(request, sources)
    on = printing.console(json=json)
    found.print_on(on)
    printing.notes_on(on, found.notes)
    printing.write_json([found.to_dict()], json)
    if found.learned.too_many_contradict:
        return 1
    found.write(target)
    printing.written("learned file", target, on)
    on.print(f"name it in the bench file, by its path from that file's folder: 'learned: {target}'")
    return 1 if strict and found.learned.contradicting else 0


@command("bench monitor day-* --baseline 5 --out monitor")
def monitor(request: Monitor, json: JsonOption = None, out: OutOption = None) -> int:
    """Chart runs of few positions over days: bias, scale factor, angle.

    Exit status 1 unless the last run is in control.
    """
    from bench.results.monitor import print_monitor
    from bench.services.history import monitored

    found = monitored(request)
    printing.bench_files(list(found.sources), json)
    files = () if out is None else found.files(out)
    printing.told(found.result, json, partial(print_monitor, found.result), files)
    return 0 if found.result.in_control else 1


@command("bench stability static.csv --size 20e-6 --bench my-bench.yaml")
def stability(request: Stability, json: JsonOption = None, out: OutOption = None) -> int:
    """Compute the Allan deviation and noise terms of a block at rest, and the averaging to use.

    Exit status 1 if no averaging reaches the allowed noise.
    """
    from bench.results.stability import print_stability
    from bench.services.stability import at_rest

    with printing.progress():
        found = at_rest(request)
    on = printing.console(json=json)
    printing.bench_file(found.taken.part(), json)
    printing.notes_on(on, found.notes)
    print_stability(found.found, on)
    printing.write_files(found.files(out), on, asked=out is not None)
    printing.write_json([found.result.to_dict()], json)
    return 0 if all(average.reached for average in found.found.averages) else 1
