"""A kind of step is one new module and one edited file."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bench.run.record import read_history

ROOT = Path(__file__).parents[3]
NEW = '''"""Tap: the operator taps the block so many times, so that what sticks comes free."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

from bench.base.languages import message
from bench.config.procedure.steps import ActionVerb, AtBench, Step, Times
from drivers.person import Prompt, PromptKind


@dataclass(frozen=True)
class Tapped:
    """The block was tapped so many times."""

    taps: int


class TapVerb(ActionVerb):
    """Have the block tapped."""

    taps: int = 3

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the tapping."""
        yield Tap(key("tap"), self.taps)


@dataclass(frozen=True, slots=True)
class Tap(Step):
    """The operator taps the block."""

    NAME: ClassVar[str] = "tap"
    BY_OPERATOR: ClassVar[bool] = True
    VERB: ClassVar[type[ActionVerb]] = TapVerb
    BRINGS: ClassVar[type] = Tapped

    taps: int

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"tap the block {self.taps} times"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return self.taps * times.operator.answer_s

    def carry_out(self, at: AtBench) -> Tapped:
        """Ask for it."""
        words = message(f"Tap the block {self.taps} times")
        at.person.ask(Prompt(self.key, PromptKind.CONFIRM, words, default="yes", action={"do": "answer"}))
        return Tapped(self.taps)
'''
EACH = """\
import sys
from bench.cli.program import main
from bench.results import plots
plots._written = lambda *figure: '<svg viewBox="0 0 1 1"></svg>'
for command in sys.argv[1:]:
    sys.argv = ["bench", *command.split()]
    try:
        assert not main()
    except SystemExit as end:
        assert not end.code, end.code
"""
PROCEDURE = """\
procedure: tapped
title: Tapped
steps:
- tap: {taps: 5}
- installation: {label: 1, steps: [tap: {}, turn: {angles: [10 deg]}]}
"""


@pytest.fixture
def program(tmp_path):
    """Return what runs commands, in one process, of a copy of the program that has one kind of step more."""
    shutil.copytree(
        ROOT / "bench", tmp_path / "bench", ignore=shutil.ignore_patterns("*.pyc.*")
    )  # being written
    for shipped in ("config", "procedures"):
        (tmp_path / shipped).symlink_to(ROOT / shipped)
    folder = tmp_path / "bench/config/procedure"
    (folder / "tap.py").write_text(NEW, encoding="utf-8")
    plan = (folder / "plan.py").read_text(encoding="utf-8")
    begins = "KINDS: Final[tuple[type[Step], ...]] = (\n"
    assert begins in plan
    imported = "from bench.config.procedure import tap\nfrom bench.config.procedure.steps import"
    plan = plan.replace(begins, f"{begins}    tap.Tap,\n")
    (folder / "plan.py").write_text(
        plan.replace("from bench.config.procedure.steps import", imported, 1), encoding="utf-8"
    )
    (tmp_path / "tapped.yaml").write_text(PROCEDURE, encoding="utf-8")

    def run(*commands):
        command = [sys.executable, "-c", EACH, *commands]
        path = os.pathsep.join([str(tmp_path), str(ROOT)])
        environment = {**os.environ, "PYTHONPATH": path}
        return subprocess.run(  # noqa: S603 - a copy of the program
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    return run


@pytest.mark.slow(4)
def test_a_kind_of_step_is_one_new_module_and_one_edited_file(program, tmp_path):
    done = program(
        "check tapped.yaml --bench paper-stand --json check.json",
        "run tapped.yaml --bench paper-stand --dry-run --name one",
    )
    assert done.returncode == 0, done.stderr
    assert "tap the block 5 times" in done.stdout
    found = json.loads((tmp_path / "check.json").read_text(encoding="utf-8"))
    assert found["counts"]["tap"] == 2
    assert found["expected_by_kind_s"]["tap"] == pytest.approx(8 * 30.0)
    brought = [e.data["taps"] for e in read_history(tmp_path / "runs/one").events if "taps" in e.data]
    assert brought == [5, 3]
