"""The third trial of the diagnosis, by a simulator of its own.

    python -m benchmarks.third_trial --seed 11 --workers 2      # 1,000 cases: nothing, catalogue, outside
    python -m benchmarks.third_trial --short                    # 50 of each kind of trial
    python -m benchmarks.third_trial --far --mistakes --forms --nulls   # other kinds of trial
    python -m benchmarks.third_trial --declared                 # its frequencies of named effects as the prior
    python -m benchmarks.third_trial --output new --against old # each case beside that of another run

Readings are made by the geometry, effects and noise of this package alone; the program receives them as tables
through its Python functions. Each case is a line of JSON in the output folder; a later call continues with the
missing cases. The tables have shares with counts and Wilson 95 % intervals, followed by each bound with the
measured value. The closed fraction of a gap is an expectation over the noise of a new day of the same design,
with another temperature. The exit status is 1 if a bound is missed.
"""

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.campaign import arguments, spread
from benchmarks.third_trial.cases import (
    MISTAKES,
    Case,
    far_case,
    form_case,
    main_case,
    mistake_case,
    null_case,
)
from benchmarks.third_trial.program import diagnosed, diagnosed_with_its_frequencies
from benchmarks.third_trial.score import JUDGED, against, report

Record = dict[str, Any]
MAKERS: Final[dict[str, tuple[Callable[[int, int], Case], int]]] = {
    "main": (main_case, 1000),
    "far": (far_case, 200),
    "mistakes": (mistake_case, 20 * len(MISTAKES)),
    "forms": (form_case, 200),
    "nulls": (null_case, 1000),
    "declared": (main_case, 1000),
}
"""The function that makes a case from a seed and a number, and the number of cases, by kind of trial."""


def of_number(trial: str, seed: int, number: int) -> Record:
    """Return the program's result for the case of this number."""
    if trial == "declared":
        return diagnosed_with_its_frequencies(main_case(seed, number))
    return diagnosed(MAKERS[trial][0](seed, number), new_day=trial == "forms")


def records(path: Path) -> list[Record]:
    """Return the lines of a file, in the order of the cases; an incomplete last line is left out."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    lines = text[: text.rfind("\n") + 1].splitlines()
    return sorted(map(json.loads, lines), key=lambda one: (one["seed"], one["number"]))


def carried_out(trial: str, seed: int, count: int, workers: int, folder: Path) -> list[Record]:
    """Diagnose the cases that are missing in the folder; return the records of all cases."""
    path = folder / f"{trial}-{seed}.jsonl"
    known = records(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(one, ensure_ascii=False) + "\n" for one in known), encoding="utf-8")
    done = {one["number"] for one in known}
    todo = [number for number in range(count) if number not in done]
    for done_now, record in enumerate(spread(partial(of_number, trial, seed), todo, workers, 1), start=1):
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, ensure_ascii=False) + "\n")
        if done_now % 50 == 0:
            print(f"{trial}: {done_now}/{len(todo)}", file=sys.stderr, flush=True)
    return [one for one in records(path) if one["number"] < count]


def main(argv: Sequence[str] | None = None) -> int:
    given = arguments(
        __doc__, argv, seed=11, workers=2,
        short=(False, "50 cases of each kind of trial"),
        cases=(int, "so many cases of each kind of trial"),
        far=(False, "files with something 8 to 40 u off"), mistakes=(False, "mistakes of procedure and wiring"),
        forms=(False, "forms outside the catalogue, tried on a new day"), nulls=(False, "nothing is missing"),
        declared=(False, "the main trial, if the program expects as many unnamed effects as there are"),
        output=(Path("third-trial"), "folder of the lines"),
        against={"type": Path, "metavar": "FOLDER", "help": "compare each case with that of another run, exactly"},
    )  # fmt: skip
    missed = 0
    for trial in [name for name in JUDGED if name != "main" and getattr(given, name)] or ["main"]:
        count = given.cases or (50 if given.short else MAKERS[trial][1])
        found = carried_out(trial, given.seed, count, given.workers, given.output)
        text, not_met = report(trial, found)
        print(text)
        missed += not_met
        if given.against:
            print(against(trial, found, records(given.against / f"{trial}-{given.seed}.jsonl")))
    return 1 if missed else 0
