"""kit: laboratories compared by a travelling block."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import typer

from bench.cli import printing
from bench.cli.commands import CommandGroup
from bench.cli.options import JsonOption, OutOption, requested
from bench.services.requests.documents import EvaluateKit, PlanKit, SealKit

GROUP: Final = typer.Typer(
    name="kit",
    cls=CommandGroup,
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Example: bench kit plan kit.yaml --laboratory Kyiv --laboratory Graz --laboratory Brno",
    help="Compare laboratories by a travelling block: plan, sealed results, report.",
)


@GROUP.command(
    epilog="Example: bench kit plan kit.yaml --laboratory Kyiv --laboratory Graz --laboratory Brno"
)
@requested
def plan(request: PlanKit) -> int:
    """Plan the route of the block, its transport checks, and a blind code for each stop."""
    from bench.certificate.interlaboratory import CHECK, kit_planned

    kit = kit_planned(request)
    on = printing.console()
    for number, stop in enumerate(kit.stops, 1):
        on.print(f"{number}. {stop.laboratory} {'(pilot) ' if stop.pilot else ''}as {stop.code}")
    on.print(f"at each stop: {CHECK}")
    printing.written("plan", Path(request.plan), on)
    return 0


@GROUP.command(epilog="Example: bench kit seal kit.yaml Q7FA=kyiv.json")
@requested
def seal(request: SealKit) -> int:
    """Note the seal (SHA-256) of each result, before any is opened."""
    from bench.certificate.interlaboratory import kit_sealed

    kit = kit_sealed(request)
    left = [stop.code for stop in kit.stops if not stop.seal]
    printing.console().print(f"not sealed yet: {', '.join(left)}" if left else "all results are sealed")
    return 0


@GROUP.command(epilog="Example: bench kit evaluate kit.yaml Q7FA=kyiv.json 9HLM=graz.xml … --out report")
@requested
def evaluate(request: EvaluateKit, json: JsonOption = None, out: OutOption = None) -> int:
    """Judge each laboratory against the consensus of the others, in the nine numbers.

    Exit status 1 if one is off, or the block changed.
    """
    from bench.certificate.interlaboratory import files_of, kit_evaluated
    from bench.results.interlaboratory import print_kit

    result = kit_evaluated(request)
    on = printing.console(json=json)
    print_kit(result, on)
    if out is not None:
        printing.write_files(files_of(result, out), on, asked=True)
    printing.write_json([result.to_dict()], json)
    return 0 if result.accepted else 1
