"""kit: laboratories compared by a travelling block."""

from __future__ import annotations

from functools import partial
from typing import Final

from bench.base.text import repeated
from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, command, group
from bench.services.errors import Refused
from bench.services.requests.documents import EvaluateKit, PlanKit, SealKit

GROUP: Final = group("kit", "bench kit plan kit.yaml --laboratory Kyiv --laboratory Graz --laboratory Brno")


@command("bench kit plan kit.yaml --laboratory Kyiv --laboratory Graz --laboratory Brno", to=GROUP)
def plan(request: PlanKit) -> int:
    """Plan the route of the block, its transport checks, and a blind code for each stop."""
    from bench.certificate.interlaboratory import CHECK, plan_kit, write_kit

    if request.plan.exists():
        raise Refused(f"{request.plan}: exists, and a plan is not overwritten; name another")
    kit = plan_kit(request.block, request.laboratory, request.seed)
    write_kit(request.plan, kit)
    on = printing.console()
    for number, stop in enumerate(kit.stops, 1):
        on.print(f"{number}. {stop.laboratory} {'(pilot) ' if stop.pilot else ''}as {stop.code}")
    on.print(f"at each stop: {CHECK}")
    printing.written("plan", request.plan, on)
    return 0


@command("bench kit seal kit.yaml Q7FA=kyiv.json", to=GROUP)
def seal(request: SealKit) -> int:
    """Note the seal (SHA-256) of each result, before any is opened."""
    from bench.certificate.interlaboratory import load_kit, sealed, write_kit

    kit = sealed(load_kit(request.plan), _by_code(request.results))
    write_kit(request.plan, kit)
    left = [stop.code for stop in kit.stops if not stop.seal]
    printing.console().print(f"not sealed yet: {', '.join(left)}" if left else "all results are sealed")
    return 0


@command("bench kit evaluate kit.yaml Q7FA=kyiv.json 9HLM=graz.xml … --out report", to=GROUP)
def evaluate(request: EvaluateKit, json: JsonOption = None, out: OutOption = None) -> int:
    """Judge each laboratory against the consensus of the others, in the nine numbers.

    Exit status 1 if one is off, or the block changed.
    """
    from bench.certificate.interlaboratory import evaluate_kit, files_of, load_kit
    from bench.results.interlaboratory import print_kit

    result = evaluate_kit(load_kit(request.plan), _by_code(request.results), request.g)
    files = () if out is None else files_of(result, out)
    printing.told(result, json, partial(print_kit, result), files)
    return 0 if result.accepted else 1


def _by_code(results: list[str]) -> dict[str, str]:
    pairs = [one.partition("=") for one in results]
    wrong = [one for one, (code, _, file) in zip(results, pairs, strict=True) if not code or not file]
    twice = repeated([code for code, _, _ in pairs])
    if wrong or twice:
        raise Refused(f"{', '.join([*wrong, *twice])}: give each result once, as CODE=FILE")
    return {code: file for code, _, file in pairs}
