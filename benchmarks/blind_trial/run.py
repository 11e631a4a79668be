"""The blind trial's command line.

    python -m benchmarks.blind_trial --short
    python -m benchmarks.blind_trial --seed 7 --workers 2 --json score.json --ledger ledger.jsonl
    python -m benchmarks.blind_trial --seed 7 --page
    python -m benchmarks.blind_trial --seed 7 --page --share 0.1      # every row, a tenth of its cases
    python -m benchmarks.blind_trial --seed 7 --page --keep trial.txt # a later call continues from this file

Cases are made from the seed, sealed (SHA-256 of the readings and of the answer) and diagnosed. Only then are the
answers opened and checked against their seals. The score is printed as Markdown, each share with the counts and its
Wilson 95 % interval. The exit status is 1 if a diagnosis failed with an error.
"""

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Final

from benchmarks.blind_trial.adapter import diagnose_case
from benchmarks.blind_trial.cases import NOISES, Row, make_case, seal
from benchmarks.blind_trial.free_positions import DESIGN, NOISE_G
from benchmarks.blind_trial.mistakes import MISTAKES, SLIPS
from benchmarks.blind_trial.outside import COMMON_VOLTS, HAND_SET, OTHER_PSI, REPAIRED, SUPPLIED
from benchmarks.blind_trial.page import stored, sums, tables, write
from benchmarks.blind_trial.perturb import perturb
from benchmarks.blind_trial.score import (
    Diagnose,
    Marks,
    Outcome,
    Task,
    judge,
    nearest_rival,
    run_trial,
    tally,
)
from benchmarks.campaign import ROOT, Kept, Share, arguments, refuse

MANY_RHO: Final = 2.3
"""Visibility rho in each of twenty runs with the same effect; together they have 10.3."""

QUIETER_RHO: Final = (5, 6, 8, 10, 15, 20)

RETURNS: Final = ("slip:visit", "rezero:visit")
"""Mistakes that only a return to an installation shows."""
LARGE_RHO: Final = 600.0
"""Visibility rho of a slip of about 10 arcmin out of the plane of rotation, or of 1 deg in it."""

KNOWN_ROWS: Final = (
    Row(OTHER_PSI), Row(COMMON_VOLTS, rho=12), Row(COMMON_VOLTS, "reordered", 12), Row(HAND_SET, "six"),
    Row(REPAIRED, rho=20),
)  # fmt: skip
FREE_ROWS: Final = (
    *(Row(kind, DESIGN, noise_v=NOISE_G) for kind in ("free:null", "free:null records", "free:outlier")),
    *(
        Row(f"free:{of}", DESIGN, rho, NOISE_G)
        for of in ("zeros", "drift", "warm_up", "square", "cube", "temperature")
        for rho in (12, 25)
    ),
)
FULL: Final[tuple[Row, ...]] = (
    Row("null", count=600),
    Row("null", noise_v=30e-6),
    Row("null", noise_v=100e-6),
    Row("null", noise_factor=0.7, count=600),
    Row("null", noise_factor=1.3, count=600),
    Row("null", "both"),
    Row("null", "turn-12"),
    *(Row("null", noise=noise, count=600) for noise in NOISES[1:]),
    *(
        Row(kind, "return" if kind in RETURNS else "paper", rho)
        for kind in SLIPS
        for rho in (8, 30, LARGE_RHO)
    ),
    *(Row("single", rho=rho) for rho in QUIETER_RHO),
    *(Row("single", design, rho) for design in ("both", "turn-12") for rho in QUIETER_RHO),
    *(Row("single", design, 10) for design in ("return", "remount-180", "reordered")),
    *(Row("single", "oven", rho) for rho in (8, 10)),
    Row("single", rho=8, noise_v=30e-6),
    Row("single", rho=8, noise_v=100e-6),
    Row("single", rho=8, noise_factor=0.7),
    Row("single", rho=8, noise_factor=1.3),
    *(Row("pair", rho=rho) for rho in (10, 15)),
    *(Row("outside", rho=rho, count=200) for rho in (12, 20)),
    *(Row("own", rho=rho) for rho in (6, 10, 20)),
    Row("hidden"),
    Row("hidden", "unverified"),
    Row("equal_k2", rho=12),
    *(Row("mounting_roll", rho=rho) for rho in (10, 20)),
    *(Row(f"mistake:{name}") for name in MISTAKES),
    *KNOWN_ROWS,
    *(Row(kind, rho=rho) for kind in SUPPLIED for rho in (8, 20)),
    *FREE_ROWS,
    Row("single", rho=MANY_RHO * 20**0.5),
    # one of these cases takes as long as forty others
    *(Row("null", runs=20, blocks=blocks, count=5) for blocks in (False, True)),
    *(Row("single", rho=MANY_RHO, runs=20, blocks=blocks, count=10) for blocks in (False, True)),
)
SHORT: Final[tuple[Row, ...]] = (
    Row("null", count=60), Row("null", noise_factor=1.3, count=30),
    *(Row("single", rho=rho, count=27) for rho in (5, 10, 20)), Row("single", "both", 10, count=27),
    Row("single", "turn-12", 10, count=27),
    *(Row("single", "oven", rho, count=27) for rho in (8, 10)), Row("pair", rho=10, count=20),
    Row("outside", rho=20, count=20),
    Row("own", rho=10, count=12), Row("hidden", count=10), Row("equal_k2", rho=12, count=5),
    Row("mounting_roll", rho=10, count=5), *(Row("null", noise=noise, count=10) for noise in NOISES[1:]),
    *(Row(kind, "return" if kind in RETURNS else "paper", 30, count=5) for kind in SLIPS),
    *(Row(f"mistake:{name}", count=5) for name in MISTAKES), *(replace(row, count=5) for row in KNOWN_ROWS),
    *(replace(row, count=3) for row in FREE_ROWS if row.rho != 12),
    *(Row(kind, rho=20, count=5) for kind in SUPPLIED),
    *(Row("single", rho=MANY_RHO, runs=20, blocks=blocks, count=4) for blocks in (False, True)),
)  # fmt: skip


_CODE: Final = ("bench", "drivers", "benchmarks/blind_trial", "benchmarks/campaign.py")
_LIBRARIES: Final = ("numpy", "scipy")


def code_sha256(root: Path = ROOT) -> str:
    """Return the SHA-256 of all that determines a diagnosis: the program, its data files, this trial, libraries."""
    whole = hashlib.sha256("".join(f"{name} {version(name)}\0" for name in _LIBRARIES).encode())
    for folder in _CODE:
        for path in sorted([root / folder, *(root / folder).rglob("*")]):
            if path.is_file() and path.suffix in {".py", ".yaml"}:
                whole.update(f"{path.relative_to(root)}\0".encode())
                whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


def kept_in(path: Path, seed: int, code: str | None = None) -> Kept:
    """Open the file of diagnoses made with a seed by a version of the code."""
    return Kept(path, {"seed": seed, "program": code or code_sha256()})


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    given = arguments(
        __doc__, argv,
        short=(False, "a few minutes instead of the whole trial"),
        seed=1, workers=2,
        rows={"type": int, "metavar": "N", "help": "so many cases in each row"},
        share=(1.0, "this part of each row's cases"),
        only={"metavar": "KIND", "help": "null, single, own, pair, outside, hidden, mistake, many, ..."},
        json={"metavar": "FILE", "help": "score and outcomes; - for standard output"},
        page=(False, "write docs/blind-trial.json, which the site shows"),
        keep=(Path, "keep diagnoses here; called again, go on where it stopped"),
        ledger=(Path, "append the seals of the cases here"),
        perturb=(False, "what changes with each constant of the diagnosis 30 %% smaller and larger"),
    )  # fmt: skip
    if not 0.0 < given.share <= 1.0:
        refuse("--share is a part of the cases, above 0 and at most 1")
    if given.page and (given.short or given.rows or given.only):
        refuse("--page is for the whole trial: leave --short, --rows and --only out")
    return given


def _rows(given: argparse.Namespace) -> list[Row]:
    chosen = SHORT if given.short else FULL
    # cases of several runs, with any hidden effect
    kinds = {row: "many" if row.runs > 1 else row.kind.split(":")[0] for row in chosen}
    rows = [row for row in chosen if given.only in (None, kinds[row])]
    if not rows:
        raise SystemExit(f"There is no kind of case called {given.only}.")
    return [replace(row, count=given.rows) for row in rows] if given.rows else of_share(rows, given.share)


def of_share(rows: Sequence[Row], share: float) -> list[Row]:
    """Return the rows with a fraction of their cases, at least one each."""
    return [replace(row, count=max(round(share * row.count), 1)) for row in rows]


def _made(given: argparse.Namespace, seconds: int) -> dict[str, object]:
    """Return the data needed to reproduce a result. Only the whole trial may write the page."""
    share = "" if given.share == 1.0 else f" --share {given.share:g}"
    command = f'make blind-trial TRIAL="--page --seed {given.seed}{share}"'
    return {
        "command": command, "seed": given.seed, "share": given.share, "seconds": seconds,
        "on": f" on {given.workers} cores",
    }  # fmt: skip


def _open_answers(outcomes: Sequence[Outcome]) -> list[tuple[Row, Marks]]:
    """Judge the diagnoses. Raises `RuntimeError` if an answer differs from the sealed one."""
    marks: list[tuple[Row, Marks]] = []
    for outcome in outcomes:
        task = outcome.task
        case, answer = make_case(task.seed, task.row, task.index)
        if seal(case, answer) != outcome.seal:
            raise RuntimeError(f"Case {case.id} is not the one that was sealed.")
        if outcome.diagnosis is None:
            marks.append((task.row, {"failed": True}))
        else:
            marks.append((task.row, judge(case, answer, outcome.diagnosis, nearest_rival)))
    return marks


def _as_json(outcomes: Sequence[Outcome], shares: dict[str, dict[str, Share]], seed: int) -> str:
    score = {
        key: {
            name: {"successes": share.successes, "of": share.of, "interval": share.interval}
            for name, share in columns.items()
        }
        for key, columns in shares.items()
    }
    cases = []
    for outcome in outcomes:
        _, answer = make_case(outcome.task.seed, outcome.task.row, outcome.task.index)
        cases.append(
            {
                **outcome.seal,
                "answer": json.loads(answer.as_json()),
                "diagnosis": outcome.diagnosis,
                "error": outcome.error or None,
            }
        )
    return json.dumps({"seed": seed, "score": score, "cases": cases}, indent=1)


def _diagnosed(tasks: Sequence[Task], diagnose: Diagnose, workers: int, kept: Kept | None) -> list[Outcome]:
    """Return the outcomes of tasks in order: kept ones are reused, failed ones are repeated."""
    done: dict[Task, Outcome] = {}
    for task in tasks if kept is not None else ():
        if kept is not None and (found := kept.get(task.row.key, task.index)):
            done[task] = Outcome(task, *found)
    todo = [task for task in tasks if task not in done]
    for number, outcome in enumerate(run_trial(todo, diagnose, workers), start=len(done) + 1):
        done[outcome.task] = outcome
        if kept is not None and not outcome.error:
            kept.keep([outcome.seal, outcome.diagnosis], outcome.task.row.key, outcome.task.index)
        if number % 200 == 0:
            print(f"{number}/{len(tasks)}", file=sys.stderr, flush=True)
    return [done[task] for task in tasks]


def main(argv: Sequence[str] | None = None, diagnose: Diagnose = diagnose_case) -> int:
    given = _arguments(argv)
    rows = _rows(given)
    tasks = [Task(given.seed, row, index) for row in rows for index in range(row.count)]
    if given.perturb:
        print("\n".join(perturb(tasks, given.workers)))
        return 0
    start = time.perf_counter()
    try:
        kept = None if given.keep is None else kept_in(given.keep, given.seed)
    except ValueError as error:
        raise SystemExit(str(error)) from error
    outcomes = _diagnosed(tasks, diagnose, given.workers, kept)
    if given.ledger:
        with given.ledger.open("a", encoding="utf-8") as ledger:
            ledger.writelines(json.dumps(outcome.seal) + "\n" for outcome in outcomes)
    shares = tally(rows, _open_answers(outcomes))
    report = sys.stderr if given.json == "-" else sys.stdout
    seconds = round(time.perf_counter() - start if kept is None else kept.seconds)
    result = stored(rows, shares, outcomes, _made(given, seconds))
    print(tables(result), file=report)
    print(f"\n{sums(result)}", file=report)
    print(f"\n{len(tasks)} cases, seed {given.seed}, {seconds} s", file=report)
    if given.page:
        write(result)
    if given.json:
        text = _as_json(outcomes, shares, given.seed)
        if given.json == "-":
            print(text)
        else:
            Path(given.json).write_text(text, encoding="utf-8")
    failures = sorted({outcome.error for outcome in outcomes if outcome.error})
    for failure in failures[:5]:
        print(failure, file=sys.stderr)
    return 1 if failures else 0
