"""diagnose: what is missing in the model; confirm: is it in new readings, too; accept: a name for it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.computing import one_thread
from bench.cli import printing
from bench.cli.options import JsonOption, app, requested
from bench.services.requests.evaluation import Accept, Confirm, Diagnose

if TYPE_CHECKING:
    from bench.services.diagnosis import Diagnosed
    from bench.services.source import Failed


@app.command(epilog="Example: bench diagnose unit-17 --json diagnosis.json")
@requested
def diagnose(
    request: Diagnose,
    together: Annotated[
        bool, typer.Option("--together", help="Several sources are one body of data, of one bench.")
    ] = False,
    json: JsonOption = None,
    strict: Annotated[bool, typer.Option("--strict", help="A discrepancy found is not accepted.")] = False,
) -> int:
    """Where readings and model disagree: name the missing effect, add it, show the gap shrink."""
    results = carried_out(request, json, together=together)
    if printing.failed(results):
        return 2
    from bench.services.source import done

    return 1 if strict and any(one.verdict != "agrees" for one in done(results)) else 0


def carried_out(request: Diagnose, target: str | None, *, together: bool) -> list[Diagnosed | Failed]:
    """Diagnose the sources and write what follows; print the results, write JSON to `target`, return them."""
    one_thread()
    from bench.services.bodies import single_bodies, whole_body
    from bench.services.diagnosis import diagnosed, print_diagnosed
    from bench.services.source import done

    printing.check_target(target)
    bodies = [whole_body(request)] if together else single_bodies(request)
    printing.bench_files([body.source for body in done(bodies)], target)
    with printing.progress():
        results = diagnosed(replace(request, write=True), bodies)
    printing.notes_aside(note for one in done(results) for note in one.not_written)
    printing.write_json([one.to_dict() for one in results], target)
    print_diagnosed(results, printing.console(json=target))
    return results


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
    with printing.progress():
        result = confirmation_of(source)
    printing.write_json([result.to_dict()], json)
    result.print_on(printing.console(json=json))
    return 0 if result.confirmed else 1


@app.command(
    epilog="Example: bench accept diagnose/unit-17-model.yaml --name cable_pull --sentence 'the cable pulls'"
)
@requested
def accept(request: Accept) -> int:
    """Give terms without a name, which a diagnosis found, a name and a sentence."""
    from bench.services.own_effects import accept_terms

    effects, model = accept_terms(request)
    told = printing.console()
    told.print(f"effect: {effects}")
    told.print(f"model: {model}")
    told.print(f"from now on: --effects {effects}, or BENCH_EFFECTS={effects}")
    return 0
