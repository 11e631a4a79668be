"""What do disturbances of its supply do to runs? Promised: no wrong value, the block never outside its limits.

    nice -n 10 python -m benchmarks.supply_campaign --runs 360 --seed 1 --jobs 1

Every trial is a dry run of a short procedure by the command line, on a shipped bench file that is made exact and
fed by a simulated supply. Once, at a random moment, a rail drops, trips, goes into current limit, drifts, loses
its contact, is switched off by hand, or the mains fail and come back. Judged: every value on record, against an
undisturbed run's and by what the rails truly had meanwhile; the block's absolute limits, in the world and not in
the driver; that a run which stopped names the supply and the rail; that resumed without a disturbance it ends with
all the readings planned, which agree, those after the block was off as another visit.
Prints a table by kind and every violation; exit status 1 when there is one.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from benchmarks.supply_trials import FedOutcome, FedStand, FedTrial, carry_out, stands
from sim.world.power import Disturbance

SHORTEST_S: Final = 5.0
"""A shorter drop may come and go within a reading, between the looks before it and after it."""


def _lasting(generator: random.Random) -> float:
    """Return how long something lasts, s: for ever, or from seconds to an hour."""
    if generator.random() < 0.5:
        return math.inf
    return math.exp(generator.uniform(math.log(SHORTEST_S), math.log(3600.0)))


def _drop(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    return Disturbance("sag", at_s, output, generator.uniform(0.02, 0.95), _lasting(generator))


def _trip(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    """Its voltage runs away until the protection strikes; without one, a contact is lost instead."""
    if stand.fed.over_voltage_v is None:
        return Disturbance("open", at_s, output, lasts_s=_lasting(generator))
    sign = 1.0 if output == stand.fed.outputs[0] else -1.0
    return Disturbance("drift", at_s, output, sign * generator.uniform(0.05, 2.0) * 3600.0)


def _limit(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    return Disturbance("load", at_s, output, generator.uniform(2.2, 30.0), _lasting(generator))


def _drift(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    """As slow as supplies drift; what has a protection may be faster."""
    most_v_h = 6.0 if stand.fed.over_voltage_v is None else 60.0
    size = generator.uniform(0.5, most_v_h) * generator.choice((-1.0, 1.0))
    return Disturbance("drift", at_s, output, size)


def _open(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    return Disturbance("open", at_s, output, lasts_s=_lasting(generator))


def _off(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    return Disturbance("off", at_s, output)


def _cut(generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    lasts_s = math.exp(generator.uniform(0.0, math.log(7200.0)))
    return Disturbance("cut", at_s, lasts_s=lasts_s)


Draw = Callable[[random.Random, FedStand, float, str], Disturbance]
KINDS: Final[Mapping[str, Draw]] = {
    "drop": _drop, "trip": _trip, "limit": _limit, "drift": _drift, "open": _open, "off": _off, "cut": _cut,
}  # fmt: skip


def draw(count: int, seed: int, benches: Sequence[FedStand]) -> list[FedTrial]:
    """Draw so many trials, the kinds in turn."""
    generator = random.Random(seed)  # noqa: S311 - nothing secret
    trials = []
    for number in range(count):
        kind = list(KINDS)[number % len(KINDS)]
        able = [b for b in benches if kind != "trip" or b.fed.over_voltage_v is not None]
        stand = generator.choice(able or list(benches))
        at_s = generator.uniform(0.0, stand.duration_s)
        disturbance = KINDS[kind](generator, stand, at_s, generator.choice(stand.fed.outputs))
        trials.append(FedTrial(str(number), stand, kind, disturbance))
    return trials


def table(outcomes: Sequence[FedOutcome]) -> str:
    """Return the table by kind."""
    by_kind: dict[str, list[FedOutcome]] = defaultdict(list)
    for outcome in outcomes:
        by_kind[outcome.trial.kind].append(outcome)
        by_kind["all"].append(outcome)
    headings = ("runs", "completed", "stopped", "resumed", "wrong", "outside", "other", "unseen")
    lines = [f"{'kind':8}" + "".join(f"{heading:>11}" for heading in headings)]
    for kind in (*KINDS, "all"):
        rows = by_kind.get(kind, [])
        wrong, outside = sum(r.wrong_values for r in rows), sum(r.outside_limits for r in rows)
        numbers = (
            len(rows),
            sum(r.completed for r in rows),
            sum(not r.completed for r in rows),
            sum(r.resumed for r in rows),
            wrong,
            outside,
            sum(len(r.violations) for r in rows) - wrong - outside,
            sum(r.unseen for r in rows),
        )
        lines.append(f"{kind:8}" + "".join(f"{number:11}" for number in numbers))
    return "\n".join(lines)


def violations(outcomes: Sequence[FedOutcome]) -> list[str]:
    """Return every violation with what led to it."""
    return [
        f"{outcome.trial.stand.fed.name} {outcome.trial.disturbance}: {text}"
        for outcome in outcomes
        for text in outcome.violations
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=350)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--stops", action="store_true", help="also print why runs stopped")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        trials = draw(given.runs, given.seed, stands(folder))
        begun_s = time.monotonic()
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            outcomes = list(pool.map(partial(carry_out, folder=folder), trials, chunksize=4))
        took_s = time.monotonic() - begun_s
    print(table(outcomes))
    print(f"{len(outcomes)} runs in {took_s:.0f} s, seed {given.seed}")
    print("unseen: completed, while a rail was gone and back between two looks, with no reading in between")
    if given.stops:
        for outcome in outcomes:
            if not outcome.completed:
                print(f"{outcome.trial.kind}: {outcome.said.strip().splitlines()[-1]}")
    found = violations(outcomes)
    for text in found:
        print(f"VIOLATION {text}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
