"""Checks before a run on real instruments: is the program validated, are the certificates valid?"""

from __future__ import annotations

import datetime
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from bench.base.languages import message
from bench.config.bench_file.file import BenchFile, Standing, load_bench, standings
from bench.run.events import EventType
from bench.run.folder import BENCH, Run
from bench.run.listening import Asker
from bench.run.person import agree
from bench.run.record import Record
from bench.services.errors import Refused
from bench.services.requests.measuring import RunRequest
from bench.services.validated import refuse_unvalidated_run
from drivers.clock import utc_now
from drivers.interfaces import BenchError
from drivers.person import Prompt, PromptKind

REMINDED_DAYS: Final = 30
"""How long before a certificate expires a reminder appears, days."""


def expired(bench: BenchFile) -> list[Standing]:
    """Return the certificates of a bench that are expired as of today."""
    return [one for one in standings(bench, utc_now().date()) if one.expired]


def reminders(bench: BenchFile) -> Iterator[str]:
    """Yield a sentence for each certificate that expires within the next 30 days."""
    today = utc_now().date()
    for one in standings(bench, today):
        until = one.certificate.valid_until
        if until is not None and today <= until <= today + datetime.timedelta(days=REMINDED_DAYS):
            left = (until - today).days
            yield (
                message(
                    f"{one.instrument}: its {one.certificate.words}, expires on {until}, in {left} "
                    f"day{'' if left == 1 else 's'}; have it calibrated"
                )
            )


def without_gravity(bench: BenchFile) -> Iterator[str]:
    """Yield a sentence if the bench file states no local gravity, because every result of a run needs it."""
    if bench.gravity_m_s2 is None:
        yield (
            message(
                "the bench file states no local gravity, so that a run ends without coefficients and verdict; "
                "add 'gravity' to it, or give --g to 'bench calibrate' and 'bench verify' after the run"
            )
        )


def is_away(answers: str | None, *, panel: bool) -> bool:
    """Return whether a person answers through the run's folder, and not at a terminal.

    This is the case if `answers` is "folder", or if it is None and a `panel` runs the program without a terminal.
    Raises `Refused` for any text but "folder" and "terminal".
    """
    if answers not in (None, "terminal", "folder"):
        raise Refused(f"--answers {answers}: give 'terminal' or 'folder'")
    return answers == "folder" or (panel and answers is None and not sys.stdin.isatty())


def refuse_contradictions(request: RunRequest) -> None:
    """Raise `Refused` for options that contradict each other, and for a real run without a bench file."""
    if not (request.bench or os.environ.get("BENCH_FILE") or request.dry_run):
        raise Refused(
            "a run on real instruments needs a bench file; give --bench FILE or set BENCH_FILE, or try it "
            "with --dry-run"
        )
    if request.model is not None and not request.dry_run:
        raise Refused("--model describes the simulated bench; add --dry-run or remove it")
    if request.follow and is_away(request.answers, panel=request.panel):
        raise Refused("--follow asks at the terminal before it continues; add --answers terminal")


def refuse_unfit(bench: BenchFile, path: Path, request: RunRequest, *, away: bool) -> None:
    """Raise `Refused` for a real run by a program that is not validated, or with expired certificates.

    With `expired: ask` in the bench file, expired certificates are refused only without a terminal, unless a
    person is `away` and can be asked through the run's folder.
    """
    refuse_unvalidated_run(bench, path, request.laboratory)
    late = expired(bench)
    if late and (
        bench.expired == "refuse" or (bench.expired == "ask" and not away and not sys.stdin.isatty())
    ):
        why, way = (
            (message("refuses such runs (expired: refuse)"), message("let a person decide (expired: ask)"))
            if bench.expired == "refuse"
            else (
                message("asks, and there is no terminal"),
                message("begin the run at a terminal, or with --answers folder"),
            )
        )
        raise Refused(
            f"{in_words(late)}; {path} {why}; have it calibrated and state the new certificate, or {way}"
        )


def in_words(late: list[Standing]) -> str:
    """Return a sentence on expired certificates."""
    return "; ".join(
        message(f"{one.instrument}: its {one.certificate.words}, expired on {one.certificate.valid_until}")
        for one in late
    )


def agree_to_expired(run: Run, record: Record, asker: Asker | None) -> None:
    """Before a real run with expired certificates and `expired: ask`, ask to go on. A no raises `BenchError`."""
    if run.simulated or asker is None:
        return
    bench = load_bench(run.folder / BENCH)
    late = expired(bench)
    if not late or bench.expired != "ask":
        return
    text = f"{in_words(late)}. Measure nevertheless?"
    try:
        agree(asker, Prompt(id="expired", kind=PromptKind.CONFIRM, text=text, action={"do": "answer"}))
    except BenchError:
        record.append(EventType.RUN_ABORTED, 0.0, reason="certificates have expired")
        raise
