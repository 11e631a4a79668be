"""Commissioning: the evening gone through, the bench left safe, its page written, however it ends."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from bench.api.errors import Refused
from bench.api.provenance import versions
from bench.api.simulated_truth import simulated_truth
from bench.assembly.commissioned import dry_evening, real_evening
from bench.base.numbers import without_infinity
from bench.base.whole import to_text, write_whole
from bench.commission.course import go_through
from bench.commission.evening import Ended, Evening
from bench.commission.finding import status_of
from bench.files.bench.file import BenchFile
from bench.report.commissioning import render_commissioning
from bench.run.signals import Interrupts
from bench.run.way_out import leave_safe
from drivers.clock import utc_now
from drivers.interfaces import Person
from drivers.wire.log import logged_wire

PAGE: Final = "commissioning.html"
RESULT: Final = "commissioning.json"
WIRE_LOG: Final = "wire.log"


@dataclass(frozen=True)
class Setting:
    """What is commissioned and where its page goes.

    Without a `person` it is the simulated bench with the scripted one; `seed` is that of its random numbers.
    `tell` shows a line.
    """

    file: BenchFile
    path: Path
    folder: Path
    person: Person | None
    seed: int = 1
    tell: Callable[[str], None] = lambda line: None


def free_folder(now: datetime) -> Path:
    """Return the folder for a commissioning that is not told one."""
    return Path(f"commissioning-{now.astimezone():%Y%m%d-%H%M%S}")


def commission(setting: Setting) -> dict[str, Any]:
    """Go through the evening; return its result, which stands in the folder beside page and wire log.

    The bench is left safe and the page written whatever happens. Raises `Refused` for a folder that cannot be
    had, `BenchError` for a simulated bench that cannot be.
    """
    _take(setting.folder)
    began = utc_now()
    with logged_wire(setting.folder / WIRE_LOG) as log, Interrupts() as interrupts:
        entered: AbstractContextManager[Evening]
        if setting.person is None:
            truth = simulated_truth(setting.file, None)
            entered = dry_evening(setting.file, truth, setting.seed, log, interrupts.haste)
        else:
            entered = nullcontext(real_evening(setting.file, setting.person, log, interrupts.haste))
        with entered as evening:
            evening.tell = setting.tell
            begun_s = evening.clock.now_s()
            ended = _gone_through(evening, interrupts)
            took_s = evening.clock.now_s() - begun_s
            to_do = leave_safe(evening.instruments, None)
        result = _result(setting, evening, began, took_s, ended, to_do)
        try:
            write_whole(setting.folder / RESULT, to_text(result))
            write_whole(setting.folder / PAGE, render_commissioning(result))
        except OSError as error:
            raise Refused(
                f"{error.filename}: cannot be written ({error.strerror}); the bench is left safe, what was found "
                "is on the screen"
            ) from error
    return result


def _take(folder: Path) -> None:
    """Make the folder. Raises `Refused` where it cannot be, or another commissioning is in it."""
    if (folder / PAGE).exists() or (folder / WIRE_LOG).exists():
        raise Refused(f"{folder}: holds a commissioning already; name another folder with --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / WIRE_LOG).touch()
    except OSError as error:
        raise Refused(
            f"{folder}: cannot be written ({error.strerror}); name another folder with --out"
        ) from error


def _gone_through(evening: Evening, interrupts: Interrupts) -> str:
    """Go through the evening; return why it ended before its end, "" where it did not.

    From its end on no signal raises anything: the bench is left safe and the page written.
    """
    try:
        try:
            go_through(evening)
        finally:
            interrupts.hold()
    except Ended as why:
        return str(why)
    except KeyboardInterrupt:
        return "stopped by a signal"
    except Exception as error:  # a mistake of the program must not keep the page from being written
        return f"the program failed with {type(error).__name__} ({error})"
    return ""


def _result(
    setting: Setting, evening: Evening, began: datetime, took_s: float, ended: str, to_do: dict[str, str]
) -> dict[str, Any]:
    instruments = []
    for section in setting.file.instruments.all():
        identity = evening.identities.get(section.name)
        instruments.append(
            {
                "name": section.name,
                "address": str(getattr(section, "resource", "by hand")),
                "identity": None if identity is None else str(identity),
            }
        )
    status = status_of(evening.findings, whole=not ended)
    result = {
        "bench": setting.file.name,
        "bench_file": str(setting.path),
        "simulated": setting.person is None,
        "began": began.isoformat(),
        "took_s": took_s,
        "status": status,
        "ended": ended,
        "instruments": instruments,
        "findings": [finding.to_json() for finding in evening.findings],
        "to_do": to_do,
        "wire_log": WIRE_LOG,
        "versions": versions(),
    }
    checked: dict[str, Any] = without_infinity(result)
    return checked
