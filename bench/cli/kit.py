"""kit: laboratories compared by a travelling block."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, command, group
from bench.services.requests.documents import EvaluateKit, PlanKit, SealKit

GROUP: Final = group("kit", "bench kit plan kit.yaml --laboratory Kyiv --laboratory Graz --laboratory Brno")


@command("bench kit plan kit.yaml --laboratory Kyiv --laboratory Graz --laboratory Brno", to=GROUP)
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


@command("bench kit seal kit.yaml Q7FA=kyiv.json", to=GROUP)
def seal(request: SealKit) -> int:
    """Note the seal (SHA-256) of each result, before any is opened."""
    from bench.certificate.interlaboratory import kit_sealed

    kit = kit_sealed(request)
    left = [stop.code for stop in kit.stops if not stop.seal]
    printing.console().print(f"not sealed yet: {', '.join(left)}" if left else "all results are sealed")
    return 0


@command("bench kit evaluate kit.yaml Q7FA=kyiv.json 9HLM=graz.xml … --out report", to=GROUP)
def evaluate(request: EvaluateKit, json: JsonOption = None, out: OutOption = None) -> int:
    """Judge each laboratory against the consensus of the others, in the nine numbers.

    Exit status 1 if a laboratory is off, or the block changed.
    """
    from bench.certificate.interlaboratory import files_of, kit_evaluated
    from bench.results.interlaboratory import print_kit

    result = kit_evaluated(request)
    files = () if out is None else files_of(result, out)
    printing.told(result, json, partial(print_kit, result), files)
    return 0 if result.accepted else 1
