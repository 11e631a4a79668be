"""Procedures written as text, for the tests of the language."""

import math
from pathlib import Path

import pytest

from bench.base.forms import FileMistakes
from bench.procedure.load import load_procedure
from bench.procedure.plan import Read

HEAD = "procedure: p\nreading: {samples: 3, nplc: 1, settle: 2 s}\nsteps:\n"


def load_steps(folder, steps, head=HEAD, **files):
    """Load a procedure of these steps; `files` are what it includes, by name."""
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
    path = folder / "p.yaml"
    path.write_text(head + steps, encoding="utf-8")
    return load_procedure(path)


def mistakes_in(folder, steps, head=HEAD, **files):
    """Return the mistakes in it: file, line, place, what is wrong."""
    with pytest.raises(FileMistakes) as error:
        load_steps(folder, steps, head, **files)
    return [f"{Path(m.file).name}{m.line} {m.place}: {m.text}" for m in error.value.mistakes]


def reads(plan):
    return [
        (s.installation, s.pass_number, s.point, round(math.degrees(s.target_rad)), s.direction)
        for s in plan.steps
        if isinstance(s, Read)
    ]
