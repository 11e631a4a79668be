"""Printing and writing that commands share: the console, JSON, notes, and common results."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bench.base.computing import heard_by, quiet
from bench.base.languages import HEADING, message, translated
from bench.base.text import bounded, visible
from bench.services.errors import Refused
from drivers.clock import Clock, SystemClock

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.base.result_model import ResultModel
    from bench.results.parts import BenchPart
    from bench.services.calibration import CalibrationResult
    from bench.services.source import Source
    from bench.services.stability import RecordCalibrationResult
    from bench.services.verification import VerdictOptions, VerificationResult

    Calibrated = CalibrationResult | RecordCalibrationResult


def console(*, json: str | None = None) -> Console:
    """Return the console for results; wide enough that no table is cut when the output is a file.

    If the JSON result goes to standard output (`json` is "-"), the console prints on standard error.
    """
    from bench.base.tables import WIDTH, Screen

    aside = json == "-"
    out = Screen(highlight=False, soft_wrap=True, markup=False, stderr=aside)
    if out.is_terminal:
        return out
    return Screen(highlight=False, soft_wrap=True, markup=False, stderr=aside, width=WIDTH)


def in_words(out: Console, text: str, style: str = "") -> None:
    """Print a text; on a terminal, wrap it between words, because the terminal itself would break words."""
    out.print(text, style=style, soft_wrap=not out.is_terminal)


def table(*headings: str, no_wrap: bool = False) -> Table:
    """Return an empty table; a heading that begins with ">" is for a column of numbers, aligned to the right."""
    from bench.base import tables

    return tables.table(*headings, no_wrap=no_wrap)


def aside(*lines: str) -> None:
    """Print lines on standard error, to keep them apart from the result on standard output."""
    for line in lines:
        print(visible(translated(line)), file=sys.stderr)


def notes_aside(notes: Iterable[str]) -> None:
    """Print notes on standard error, so that standard output is JSON alone; nothing with `--quiet`."""
    if not quiet.get():
        aside(*(f"note: {note}" for note in notes))


def notes_on(out: Console, notes: Iterable[str]) -> None:
    """Print notes with a result; with `--quiet`, only JSON and page contain them."""
    from bench.base.tables import print_notes

    print_notes(out, notes)


# --- results as JSON and in files -------------------------------------------------------------------


def write_json(results: list[dict[str, Any]], target: str | None) -> None:
    """Write one result, or a list of several, to the file `target`; "-" is standard output, None writes nothing."""
    from bench.base.files import to_text, write_whole

    if target is None:
        return
    result = results[0] if len(results) == 1 else results
    text = to_text(result)
    if target == "-":
        try:
            text.encode(sys.stdout.encoding or "utf-8")
        except UnicodeEncodeError:  # JSON has its own escapes
            text = to_text(result, only_ascii=True)
        sys.stdout.write(text)
    else:
        write_whole(Path(target), text)


def told(
    result: ResultModel,
    json: str | None,
    show: Callable[[Console], None],
    files: Iterable[tuple[str, Path, str | bytes]] = (),
) -> int:
    """Print a result by `show`, write its `files` (description, path, content) and its JSON; return 0."""
    out = console(json=json)
    show(out)
    write_files(files, out, asked=True)
    write_json([result.to_dict()], json)
    return 0


def failed(results: Sequence[object]) -> bool:
    """Print a line for each source that could not be evaluated; return whether there are such sources.

    Raises `Refused` if several sources failed for the same reason: its cause is then not in the sources.
    """
    from bench.services.source import failures

    found = failures(results)
    if len(found) > 1 and len({one.problem for one in found}) == 1:
        raise Refused(found[0].problem)  # the cause is not in the sources
    for one in found:
        print(f"bench: {visible(bounded(translated(str(one))))}", file=sys.stderr)
    if found:
        aside(message(f"bench: {len(found)} of {len(results)} sources could not be evaluated"))
    return bool(found)


def write_beside(path: Path, text: str | bytes, *, asked: bool) -> bool:
    """Write a derived file beside its source; return whether it was written.

    If the folder is not writable, a requested file (`asked`) raises `OSError`; any other file is left out, with a
    note.
    """
    from bench.base.files import write_whole

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
    except OSError as error:
        if asked:
            raise
        notes_aside([f"{os.fspath(path)} was not written ({error.strerror}); use --out DIR"])
        return False
    return True


def write_result(
    source: Source, command: str, result: dict[str, Any], *, what_if: bool = False
) -> Path | None:
    """Write the result of a command on a source to its usual file; return the path of the file.

    If the folder is not writable, raise `OSError` if the user named the folder (`--out`), else return None. A
    result computed with options other than those of the run (`what_if`) has a separate file.
    """
    from bench.base.files import to_text

    file = source.output(command, ".json", what_if=what_if)
    return file if write_beside(file, to_text(result), asked=source.request.out is not None) else None


def write_files(files: Iterable[tuple[str, Path, str | bytes]], out: Console, *, asked: bool) -> None:
    """Write derived files (description, path, content) as `write_beside` does, and print where each was written."""
    for what, file, text in files:
        if write_beside(file, text, asked=asked):
            written(what, file, out)


def written(what: str, file: Path, out: Console | None = None) -> None:
    """Print where a file was written; for a what-if result, add that the run's own result is unchanged."""
    from bench.services.source import WHAT_IF

    told = translated(what, HEADING)
    if file.parent.name == WHAT_IF:
        told = translated(message(f"{told} of this what-if (the run's own stays)"))
    (out or console()).print(f"{told}: {file}")


# --- what a result is made with ---------------------------------------------------------------------


def bench_file(taken: BenchPart, json: str | None, of: str = "") -> None:
    """Print which bench file is used, and the reason; `of` names the readings if there are several.

    Print nothing if the JSON result, which names the bench file, goes to standard output (`json` is "-").
    """
    if json != "-":
        if of:
            told = message(f"bench file of {of}: {taken.name}, {taken.why} ({taken.file})")
        else:
            told = message(f"bench file: {taken.name}, {taken.why} ({taken.file})")
        console().print(told)


def bench_files(sources: Sequence[Source], json: str | None) -> None:
    """Print which bench file is used for each source, in one line if it is the same for all."""
    one = len({source.taken.where for source in sources}) == 1
    for source in sources[:1] if one else sources:
        bench_file(source.taken.part(), json, "" if one else source.name)


# --- results that several commands print ------------------------------------------------------------


def evaluated(
    result: Calibrated | VerificationResult, command: str, json: str | None, *, what_if: bool
) -> None:
    """Write a result (`what_if` as in `write_result`) and print it; with `--json -`, print only its notes."""
    file = write_result(result.source, command, result.to_dict(), what_if=what_if or result.source.what_if)
    if json == "-":
        notes_aside(result.notes)
        return
    out = console()
    result.print_on(out)
    if file is not None:
        written("result", file, out)


def report(
    result: Calibrated, out: Console, asked: VerdictOptions | None = None
) -> tuple[VerificationResult | None, Path]:
    """Write the report of a calibration, judged by the options `asked`; return its verification and the file.

    The verification is None without verification points, or if they joined the fit. Raises `OSError`.
    """
    from bench.base.files import write_whole
    from bench.services.calibration import report_page

    page, verdict = report_page(result, asked)
    what_if = result.source.what_if or (verdict is not None and verdict.otherwise)
    file = result.source.output("report", ".html", what_if=what_if)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, page)
    written("report", file, out)
    return verdict, file


_REMEMBERED_S: Final = 3600.0
"""Period (s) over which the speed is estimated. It is long because a single part may take minutes."""


@contextmanager
def progress(console: Console | None = None, clock: Clock | None = None) -> Iterator[None]:
    """Show a bar with the name of the computation, its progress and the time left, within a context.

    It is shown only on a terminal (by default that of standard error), not with `--quiet`, and erased at the end.
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
        TextColumn(translated(message("left", "heading"), HEADING)),
        console=console,
        transient=True,
        speed_estimate_period=_REMEMBERED_S,
        get_time=(clock or SystemClock()).now_s,
    )
    task = bar.add_task("…", total=None)

    def hear(what: str, done: int, total: int) -> None:
        if (name := translated(what, HEADING)) != bar.tasks[0].description:
            bar.reset(task, description=name, total=total)
        bar.update(task, completed=done, refresh=True)

    with bar, heard_by(hear):
        yield


EVERY_S: Final = 30.0


@contextmanager
def in_lines() -> Iterator[None]:
    """Print progress as lines on standard error, for the log of a long computation.

    A line is printed at most every 30 s, none if standard error is a terminal or with `--quiet`.
    """
    if sys.stderr.isatty() or quiet.get():
        yield
        return
    clock = SystemClock()
    began_s = said_s = clock.now_s()

    def hear(what: str, done: int, total: int) -> None:
        nonlocal said_s
        now_s = clock.now_s()
        if done and now_s - said_s >= EVERY_S:
            left_s = round((now_s - began_s) / done * (total - done))
            told = message(
                f"{done:,} of {total:,} {translated(what, HEADING)}, {timedelta(seconds=left_s)} left"
            )
            print(translated(told), file=sys.stderr, flush=True)
            said_s = now_s

    with heard_by(hear):
        yield


def passphrase(question: str, again: str = "") -> bytes:
    """Ask for a passphrase, and a second time with the question `again` if that is given.

    Raises `Refused` for an empty passphrase, or for two that differ.
    """
    typed = _line(question)
    if not typed:
        raise Refused("no passphrase given; type it at the prompt")
    if again and _line(again) != typed:
        raise Refused("the two passphrases differ; start again")
    return typed.encode()


def _line(question: str) -> str:
    if sys.stdin.isatty():
        from getpass import getpass

        return getpass(question)
    return sys.stdin.readline().rstrip("\r\n")
