"""Procedures written as text, for tests of the procedure language."""

import math
from pathlib import Path

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.procedure.load import Procedure, load_procedure
from bench.config.procedure.plan import Plan, Read

TWO_INSTALLATIONS = """\
procedure: two
title: Two installations that do not make a calibration together, so that none is made
reading: {samples: 5, nplc: 1, settle: 2 s}
steps:
  - installation: {label: 1, steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 8}}]}
  - installation: {label: 1T180, steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 8}}]}
"""

HEAD = "procedure: p\nreading: {samples: 3, nplc: 1, settle: 2 s}\nsteps:\n"


def load_steps(folder: Path, steps: str, head: str = HEAD, **files: str) -> Procedure:
    """Load a procedure with these steps; `files` are the texts of procedures that it includes, by name."""
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
    path = folder / "p.yaml"
    path.write_text(head + steps, encoding="utf-8")
    return load_procedure(path)


def mistakes_in(folder: Path, steps: str, head: str = HEAD, **files: str) -> list[str]:
    """Return the mistakes in such a procedure: file, line, place, text."""
    with pytest.raises(FileMistakes) as error:
        load_steps(folder, steps, head, **files)
    return [f"{Path(m.file).name}{m.line} {m.place}: {m.text}" for m in error.value.mistakes]


def reads(plan: Plan) -> list[tuple[str, int, int, int, int | None]]:
    found: list[tuple[str, int, int, int, int | None]] = []
    for s in plan.steps:
        if isinstance(s, Read):
            assert s.target_rad is not None
            degrees = round(math.degrees(s.target_rad))
            found.append((s.installation, s.pass_number, s.point, degrees, s.direction))
    return found
