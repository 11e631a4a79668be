"""What do a thousand faults on the wire do to runs? Promised: no hang, no traceback, no wrong value.

    python -m benchmarks.fault_campaign --faults 1200 --seed 1 --jobs 2

Every trial is a dry run of a short procedure by the command line, on a bench file of `config` whose stand,
voltmeters and operator are made exact and whose timeouts short (0.2 s). One fault of a random kind strikes one
instrument at a random exchange; in a storm five do. Judged: the time of the run; what stands on standard
error; the record's chain of hashes; every sample on record against the forward model at the recorded angle;
that a run which stopped names the instrument, and resumed without faults ends with all the readings planned.
Prints a table by kind of fault and every violation; exit status 1 when there is one.
"""

from __future__ import annotations

import argparse
import faulthandler
import random
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from benchmarks.fault_trials import LIMIT_S, ROOT, Outcome, Stand, Trial, carry_out, stands
from sim.wires.faults import Fault, FaultKind

STUCK_S: Final = 90.0
STORM: Final = "storm"
STORM_FAULTS: Final = 5
KINDS: Final = (*FaultKind, STORM)
_LAST_OF_SECONDS: Final = 0.6
_ERRORS: Final = (-222, -113, -410)


def draw(count: int, seed: int, benches: Sequence[Stand]) -> list[Trial]:
    """Draw trials with `count` faults at least, the kinds in turn."""
    generator = random.Random(seed)  # noqa: S311 - nothing secret
    trials: list[Trial] = []
    faults = 0
    while faults < count:
        kind = KINDS[len(trials) % len(KINDS)]
        stand = generator.choice([b for b in benches if kind == STORM or b.able[kind]])
        if kind == STORM:
            drawn = tuple(
                draw_fault(generator, stand, generator.choice([k for k in FaultKind if stand.able[k]]))
                for _ in range(STORM_FAULTS)
            )
        else:
            drawn = (draw_fault(generator, stand, FaultKind(kind)),)
        trials.append(Trial(str(len(trials)), stand, kind, drawn))
        faults += len(drawn)
    return trials


def draw_fault(generator: random.Random, stand: Stand, kind: FaultKind) -> Fault:
    """Draw instrument, exchange and duration of a fault."""
    instrument = generator.choice(stand.able[kind])
    seconds = 0.0
    if kind is FaultKind.LATE:
        seconds = generator.uniform(0.02, _LAST_OF_SECONDS)
    elif kind in (FaultKind.REFUSE, FaultKind.HANG):
        seconds = generator.choice((0.0, 0.1, _LAST_OF_SECONDS))
    exchanges = stand.exchanges[instrument]
    # Half of them in the second half, where the readings are.
    first = generator.choice((1, max(1, exchanges // 2)))
    return Fault(
        kind,
        at=generator.randint(first, exchanges),
        seconds=seconds,
        error=generator.choice(_ERRORS),
        instrument=instrument,
    )


def guarded(trial: Trial, folder: Path, limit_s: float) -> Outcome:
    """Carry a trial out; what is stuck for good is shown with its threads, and ends the campaign."""
    faulthandler.dump_traceback_later(STUCK_S, exit=True, file=2)
    outcome = carry_out(trial, folder, limit_s)
    faulthandler.cancel_dump_traceback_later()
    return outcome


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the table by kind of fault."""
    by_kind: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        by_kind[str(outcome.trial.kind)].append(outcome)
        by_kind["all"].append(outcome)
    headings = ("runs", "faults", "struck", "completed", "stopped", "resumed", "wrong", "hangs", "other")
    lines = [f"{'fault':14}" + "".join(f"{heading:>10}" for heading in headings) + f"{'worst':>10}"]
    for kind in (*map(str, KINDS), "all"):
        rows = by_kind.get(kind, [])
        if not rows:
            continue
        hangs = sum(any(text.startswith("hang") for text in row.violations) for row in rows)
        violations = sum(len(row.violations) for row in rows)
        wrong = sum(row.wrong_values for row in rows)
        numbers = (
            len(rows),
            sum(len(row.trial.faults) for row in rows),
            sum(row.struck for row in rows),
            sum(row.completed for row in rows),
            sum(not row.completed for row in rows),
            sum(row.resumed for row in rows),
            wrong,
            hangs,
            violations - wrong - hangs,
        )
        worst_s = max(row.time_s for row in rows)
        lines.append(f"{kind:14}" + "".join(f"{number:10}" for number in numbers) + f"{worst_s:8.2f} s")
    return "\n".join(lines)


def violations(outcomes: Sequence[Outcome]) -> list[str]:
    """Return every violation with what led to it."""
    told = []
    for outcome in outcomes:
        faults = "; ".join(str(fault.told()) for fault in outcome.trial.faults)
        told += [f"{outcome.trial.stand.name} {faults}: {text}" for text in outcome.violations]
    return told


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=1200, help="at least so many")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="how long a run may take, s")
    parser.add_argument("--bench", nargs="*", help="shipped bench files by name (default: all)")
    parser.add_argument("--stops", action="store_true", help="also print why runs stopped")
    given = parser.parse_args()
    names = given.bench or sorted(file.stem for file in (ROOT / "config").glob("*.yaml"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        benches = stands(folder, names)
        trials = draw(given.faults, given.seed, benches)
        begun_s = time.monotonic()
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            work = partial(guarded, folder=folder, limit_s=given.limit)
            outcomes = list(pool.map(work, trials, chunksize=4))
        took_s = time.monotonic() - begun_s
    for stand in benches:
        print(f"{stand.name}: exchanges in a run: {dict(stand.exchanges)}")
    print(table(outcomes))
    print(f"{len(outcomes)} runs in {took_s:.0f} s, seed {given.seed}")
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
