"""Procedures that may be chosen: title, duration, number of readings, and a drawing of the test points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from bench.base.yaml_files import FileMistakes
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Mount, Read, Turn
from bench.config.shipped import PROCEDURES
from bench.panel.launching import choices
from bench.run.sentences import duration

MOST_OFFERED: Final = 500
"""Number of procedures whose duration is cached."""


@dataclass(frozen=True)
class OfferedProcedure:
    """A procedure as the form offers it: its title, expected time, number of readings, and a drawing.

    `dots` are the test points by angle, as (x to the right, y down) on a circle of radius 1. For a file with
    mistakes, `title` is the first mistake and all else is empty.
    """

    name: str
    title: str
    expected_s: float = 0.0
    readings: int = 0
    mountings: int = 0
    dots: tuple[tuple[float, float], ...] = ()

    @property
    def time(self) -> str:
        """The expected time in words, empty for a file with mistakes."""
        return duration(self.expected_s) if self.dots or self.expected_s else ""


def offered_procedures() -> list[OfferedProcedure]:
    """Return the procedures that may be chosen, each with its duration on a typical bench."""
    return [offered(name, file) for name, file in choices(PROCEDURES).items()]


def offered(name: str, file: Path) -> OfferedProcedure:
    """Return a procedure as the forms offer it; it is cached until its file changes."""
    return _offered(name, file, file.stat().st_mtime_ns if file.is_file() else 0)


@lru_cache(maxsize=MOST_OFFERED)
def _offered(name: str, file: Path, _changed_ns: int) -> OfferedProcedure:
    try:
        procedure = load_procedure(file)
    except (FileMistakes, OSError, ValueError) as mistakes:
        return OfferedProcedure(name, str(mistakes).partition("\n")[0])
    plan = procedure.plan
    angles = sorted({step.target_rad for step in plan.steps if isinstance(step, Turn)})
    return OfferedProcedure(
        name,
        procedure.title,
        plan.expected_duration_s(),
        sum(isinstance(step, Read) for step in plan.steps),
        sum(isinstance(step, Mount) for step in plan.steps),
        tuple((round(math.sin(angle), 3), round(-math.cos(angle), 3)) for angle in angles),
    )
