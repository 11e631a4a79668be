"""What commands share in printing and writing: the console, JSON, notes, and results that several print."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bench.base.computing import heard_by, quiet
from bench.base.text import bounded, visible
from bench.services.errors import Refused
from drivers.clock import Clock, SystemClock

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.results.parts import BenchPart
    from bench.services.calibration import CalibrationResult
    from bench.services.source import Source
    from bench.services.verification import VerdictOptions, VerificationResult


def console(*, json: str | None = None) -> Console:
    """Return the console for results; wide enough that no table is cut when the output is a file.

    Where `json` goes to standard output ("-"), what is written for a person goes to standard error.
    """
    from bench.base.tables import WIDTH, Screen

    aside = json == "-"
    out = Screen(highlight=False, soft_wrap=True, markup=False, stderr=aside)
    if out.is_terminal:
        return out
    return Screen(highlight=False, soft_wrap=True, markup=False, stderr=aside, width=WIDTH)


def table(*headings: str, no_wrap: bool = False) -> Table:
    """Return an empty table; a heading that begins with ">" stands over a column of numbers, to the right."""
    from bench.base import tables

    return tables.table(*headings, no_wrap=no_wrap)


def aside(*lines: str) -> None:
    """Print lines on standard error, beside a result on standard output."""
    for line in lines:
        print(visible(line), file=sys.stderr)


def notes_aside(notes: Iterable[str]) -> None:
    """Print notes beside a result: standard output is JSON alone."""
    if not quiet.get():
        aside(*(f"note: {note}" for note in notes))


def notes_on(out: Console, notes: Iterable[str]) -> None:
    """Print notes among a result; `--quiet` leaves them to the JSON and the page."""
    from bench.base.tables import print_notes

    print_notes(out, notes)


# --- results as JSON and in files -------------------------------------------------------------------


def write_json(results: list[dict[str, Any]], target: str | None) -> None:
    """Write one result, or a list of several in the order of the sources, to a file or standard output."""
    from bench.base.files import to_text, write_whole

    if target is None:
        return
    text = to_text(results[0] if len(results) == 1 else results)
    if target == "-":
        sys.stdout.write(text)
    else:
        write_whole(Path(target), text)


def failed(results: Sequence[object]) -> bool:
    """Say which of several sources could not be evaluated, a line each; return whether there is any."""
    from bench.services.source import failures

    found = failures(results)
    if len(found) > 1 and len({one.problem for one in found}) == 1:
        raise Refused(found[0].problem)  # it is not the sources
    for one in found:
        print(f"bench: {visible(bounded(str(one)))}", file=sys.stderr)
    if found:
        print(f"bench: {len(found)} of {len(results)} sources could not be evaluated", file=sys.stderr)
    return bool(found)


def write_beside(path: Path, text: str | bytes, *, asked: bool) -> bool:
    """Write a derived file; say so and go on where the place is not writable, unless it was asked for."""
    from bench.base.files import write_whole

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
    except OSError as error:
        if asked:
            raise
        notes_aside([f"{os.fspath(path)} is not written ({error.strerror}); use --out DIR"])
        return False
    return True


def write_result(
    source: Source, command: str, result: dict[str, Any], *, what_if: bool = False
) -> Path | None:
    """Write the result of a command where what is derived from the source belongs; None where it cannot be.

    A result of other options than the run's own (`what_if`) is written beside the run's own, never over it.
    """
    from bench.base.files import to_text

    file = source.output(command, ".json", what_if=what_if)
    return file if write_beside(file, to_text(result), asked=source.request.out is not None) else None


def write_files(files: Iterable[tuple[str, Path, str | bytes]], out: Console, *, asked: bool) -> None:
    """Write derived files, each with what it is, and say where; as `write_beside`."""
    for what, file, text in files:
        if write_beside(file, text, asked=asked):
            written(what, file, out)


def written(what: str, file: Path, out: Console | None = None) -> None:
    """Say where a file was written; of a what-if, that the run's own stands as it was."""
    from bench.services.source import WHAT_IF

    of = "" if file.parent.name != WHAT_IF else " of this what-if (the run's own stays)"
    (out or console()).print(f"{what}{of}: {file}")


# --- what a result is made with ---------------------------------------------------------------------


def bench_file(taken: BenchPart, json: str | None, of: str = "") -> None:
    """Say first which bench file is taken, and why that one; `of` which readings, where there are several.

    Where the result goes to standard output (`json` is "-"), it says it by itself, and errors stay alone.
    """
    if json != "-":
        console().print(f"bench file{of and f' of {of}'}: {taken.words} ({taken.file})")


def bench_files(sources: Sequence[Source], json: str | None) -> None:
    """Say first which bench file is taken for each source, in one line where it is one for all."""
    one = len({source.taken.where for source in sources}) == 1
    for source in sources[:1] if one else sources:
        bench_file(source.taken.part(), json, "" if one else source.name)


# --- results that several commands print ------------------------------------------------------------


def calibration(result: CalibrationResult, file: Path | None, out: Console | None = None) -> None:
    """Print the coefficients, the noise, the fit, and where they were written."""
    out = out or console()
    result.print_on(out)
    if file is not None:
        written("result", file, out)


def verification(result: VerificationResult, file: Path | None, out: Console | None = None) -> None:
    """Print Δg at each verification point and the verdict."""
    out = out or console()
    result.print_on(out)
    if file is not None:
        written("result", file, out)
    out.print(result.verdict(), style="bold")


def report(
    result: CalibrationResult, out: Console, asked: VerdictOptions | None = None
) -> tuple[VerificationResult | None, Path]:
    """Write the page of a calibration; return the verification that is in it, and the file. Raises `OSError`."""
    from bench.base.files import write_whole
    from bench.services.calibration import report_page
    from bench.services.verification import NOTHING_ASKED

    page, verdict = report_page(result, asked or NOTHING_ASKED)
    what_if = result.source.what_if or (verdict is not None and verdict.otherwise)
    file = result.source.output("report", ".html", what_if=what_if)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, page)
    written("report", file, out)
    return verdict, file


_REMEMBERED_S: Final = 3600.0
"""A part may take minutes: how fast the last ones were done is remembered for so long."""


@contextmanager
def progress(console: Console | None = None, clock: Clock | None = None) -> Iterator[None]:
    """Show what is computed, how much of it is done and the time left, as long as the context lasts.

    On a terminal only (standard error's, if no console is given), never with --quiet; nothing of it stays.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    console = console or Console(stderr=True)
    if not console.is_terminal or quiet.get():
        yield
        return
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=console,
        transient=True,
        speed_estimate_period=_REMEMBERED_S,
        get_time=(clock or SystemClock()).now_s,
    )
    task = bar.add_task("…", total=None)

    def hear(what: str, done: int, total: int) -> None:
        if what != bar.tasks[0].description:
            bar.reset(task, description=what, total=total)
        bar.update(task, completed=done, refresh=True)

    with bar, heard_by(hear):
        yield


EVERY_S: Final = 30.0


@contextmanager
def in_lines(clock: Clock | None = None) -> Iterator[None]:
    """Say on standard error what `shown` shows, where that is no terminal: a line now and then, for a log.

    For what may take hours. Never with --quiet.
    """
    if sys.stderr.isatty() or quiet.get():
        yield
        return
    clock = clock or SystemClock()
    began_s = said_s = clock.now_s()

    def hear(what: str, done: int, total: int) -> None:
        nonlocal said_s
        now_s = clock.now_s()
        if done and now_s - said_s >= EVERY_S:
            left_s = round((now_s - began_s) / done * (total - done))
            print(
                f"{done:,} of {total:,} {what}, {timedelta(seconds=left_s)} left", file=sys.stderr, flush=True
            )
            said_s = now_s

    with heard_by(hear):
        yield


def passphrase(question: str, again: str = "") -> bytes:
    """Ask for a passphrase, twice where `again` asks for it once more. Raises `Refused` for none, or for two."""
    typed = _line(question)
    if not typed:
        raise Refused("a passphrase is wanted, and none was given")
    if again and _line(again) != typed:
        raise Refused("the two passphrases are not the same; begin again")
    return typed.encode()


def _line(question: str) -> str:
    if sys.stdin.isatty():
        from getpass import getpass

        return getpass(question)
    return sys.stdin.readline().rstrip("\r\n")
