"""Every example of the documentation is carried out, and prints what the page shows."""

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from bench.batch.work import worked
from bench.calibration import ESTIMATORS
from bench.cli.commands import COMMANDS
from bench.cli.options import app
from bench.config.model_file import load_model
from bench.model import Conditions
from bench.model import geometry as blocks_model
from bench.model.conditions import Mounting
from bench.model.effects import CATALOGUE
from bench.readings.csv import write_csv
from bench.validation.paper_bench import simulate
from docs.generators.commands import commands as commands_there_are
from tests.support.honest_runs import MODEL
from tests.support.pages import DOCS, ROOT, Block, blocks, commands, pages, told_apart
from tests.support.schemas import keeps_to

KINDS = {"console", "python", "text", "yaml", "{toctree}", "{include}", "{picture}"}
OF_THEIR_OWN = {f"writing-{name}.md" for name in ("a-driver", "an-effect", "an-estimator", "a-command")}
"""Pages whose blocks need names of the tests: they have a test of their own."""
RESULTS = {
    "tutorial.md": {
        "coefficients.json": "calibrate",
        "runs/first/calibrate.json": "calibrate",
        "runs/first/verify.json": "verify",
        "diagnosis.json": "diagnose",
    },
    "analyses.md": {"tests/data/stability/ln100-up.json": "stability"},
}
"""What pages leave behind, and the schema of each."""
SLOWLY = "tutorial analyses how-it-works certificates catalogue batches check-block real-records learning run-until"
SLOW = {f"{name}.md" for name in SLOWLY.split()}
SHELL = {"ls", "cp", "rm", "sed"}


def carried_out(page, bench):
    """Carry out the blocks of a page one after another in the working folder."""
    names = {"__name__": "page"}
    printed = ""
    for block in blocks(page):
        where = f"{block.page}:{block.line}"
        if block.why_not_run:
            continue
        if block.kind == "console":
            take_data(block)
            for command in commands(block):
                status, printed = run(command.words, bench)
                problem = told_apart(command.shown, printed)
                if problem:
                    pytest.fail(f"{where}: {' '.join(command.words)}: {problem}", pytrace=False)
                if not command.shown:
                    assert status == 0, f"{where}: {printed}"
            expected = int(block.marked("status") or 0)
            assert status == expected, f"{where}: {printed}"
        elif block.kind == "yaml":
            assert block.marked("file"), f"{where}: say which file this is"
            Path(block.marked("file")).write_text(block.text, encoding="utf-8")
        elif block.kind == "python":
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(block.text, where, "exec"), names)  # noqa: S102 - our own page
            printed = out.getvalue()
        elif block.kind == "text" and printed and not printed.isspace():
            assert not told_apart(block.text.splitlines(), printed), where
    return names


def take_data(block):
    source = block.marked("data")
    if source:
        target = Path(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / source, target)


def run(words, bench):
    if words[0] == "bench":
        status, out, err = bench(*words[1:])
        return status, out + err
    assert words[0] in SHELL, words
    done = subprocess.run(words, capture_output=True, text=True, check=True)  # noqa: S603 - our own page
    return done.returncode, done.stdout


@pytest.fixture
def wide(monkeypatch):
    """Lines as long as they are."""
    monkeypatch.setenv("COLUMNS", "400")


@pytest.fixture
def in_this_process(monkeypatch):
    """Batches compute here: processes of their own import the whole program, and have tests of their own."""
    monkeypatch.setattr(
        "bench.batch.processes.by_processes", lambda job, runs, count: (worked(job, run) for run in runs)
    )


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, id=p.name, marks=[pytest.mark.slow] if p.name in SLOW else [])
        for p in pages()
        if p.name not in OF_THEIR_OWN
    ],
)
def test_what_a_page_shows_is_what_happens(page, bench, wide, in_this_process):
    carried_out(page, bench)
    for written, schema in RESULTS.get(page.name, {}).items():
        keeps_to(schema, json.loads(Path(written).read_text(encoding="utf-8")))


@pytest.mark.parametrize("page", pages(), ids=lambda p: p.name)
def test_no_block_escapes(page):
    for block in blocks(page):
        assert block.kind in KINDS, f"{block.page}:{block.line}: a block of no known kind"
    assert page.read_text(encoding="utf-8").count("```") == 2 * len(blocks(page))


@pytest.mark.parametrize("page", pages(), ids=lambda p: p.name)
def test_commands_that_are_not_carried_out_exist_with_their_options(page):
    known = known_options()
    for block in blocks(page):
        if block.kind != "console" or not block.why_not_run:
            continue
        _, _, why = block.why_not_run.partition(": ")
        assert len(why) > 10, f"{block.page}:{block.line}: say why this is not carried out"
        for command in commands(block):
            if command.words[0] == "bench":
                assert_exists(command.words[1:], known, f"{block.page}:{block.line}")


def test_commands_in_the_text_exist_with_their_options():
    known = known_options()
    told = 0
    for page in pages():
        text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for code in re.findall(r"`bench ([a-z][^`]*)`", text.replace("\n", " ")):
            told += 1
            assert_exists(code.split(), known, page.name)
    assert told > 40


@cache
def known_options():
    return {
        name: {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help", "--debug"}
        for name, command in commands_there_are().items()
    }


def assert_exists(words, known, where):
    name = words[0]
    if f"{name} issue" in known:  # a group, of which that stands for itself
        word = words[1] if len(words) > 1 else ""
        name = f"{name} {word}" if f"{name} {word}" in known else f"{name} issue"
    elif any(one.startswith(f"{name} ") for one in known):  # a group: each of its commands by its name
        word = words[1] if len(words) > 1 else ""
        if word in {"", "…"} or "|" in word:
            return
        name = f"{name} {word}"
    assert name in known, f"{where}: there is no command {name}"
    for word in words[1:]:
        option = word.partition("=")[0]
        if option.startswith("--"):
            assert option in known[name], f"{where}: {name} has no option {option}"


def test_the_page_of_a_command_is_one_module_and_one_line(bench, wide, monkeypatch):
    page = DOCS / "writing-a-command.md"
    code, line, console = (block for block in blocks(page) if block.kind in {"python", "console"})
    module = ModuleType("bench.cli.gravity")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(app, "registered_commands", list(app.registered_commands))
    for name, text in eval(f"{{{line.text}}}").items():  # noqa: S307 - our own page
        monkeypatch.setitem(COMMANDS, name, text)
    exec(compile(code.text, str(page), "exec"), vars(module))  # noqa: S102 - our own page
    shown = list(commands(console))
    ran = [run(command.words, bench) for command in shown]
    assert [status for status, _ in ran] == [0, 2]
    assert [told_apart(c.shown, printed) for c, (_, printed) in zip(shown, ran, strict=True)] == ["", ""]


@pytest.mark.slow
def test_the_page_of_an_effect(bench, wide, tmp_path):
    names = carried_out(DOCS / "writing-an-effect.md", bench)
    names["conditions_at"] = one_reading_at
    names["test_half_a_turn_pulls_by_half"]()
    effect = names["CablePull"]()
    with CATALOGUE.also([effect]):
        (applied,) = load_model(tmp_path / "stiff.yaml").applied_effects()
    assert applied.effect is effect
    assert float(applied.values["per_turn"]) == pytest.approx(np.radians(60 / 3600))
    args = blocks_model.Block(-2.0 * np.eye(3), np.zeros(3)), one_reading_at(np.pi / 2), np.zeros((1, 5))
    pulled = replace(MODEL, effects=(applied,)).readings(*args) - MODEL.readings(*args)
    assert np.abs(pulled).max() == pytest.approx(2.0 * np.radians(15 / 3600), rel=1e-3)


def one_reading_at(angle_rad):
    unknown, one = np.full(1, np.nan), np.ones(1, dtype=int)
    mounts, order = (Mounting(1, "1"),), np.arange(3)[np.newaxis]
    angle = np.array([angle_rad])
    return Conditions(mounts, 0 * one, one, one, angle, one, unknown, unknown, order)


def test_the_page_of_an_estimator(bench, wide, monkeypatch):
    write_csv(simulate(np.random.default_rng(5), 1e-4), Path("readings.csv"))
    page = DOCS / "writing-an-estimator.md"
    code, command, proof = (block for block in blocks(page) if block.kind in {"python", "console"})
    names = {}
    exec(compile(code.text, str(page), "exec"), names)  # noqa: S102 - our own page
    estimator = names["ESTIMATOR"]
    monkeypatch.setitem(ESTIMATORS, estimator.name, estimator)
    (shown,) = commands(command)
    status, printed = run(shown.words, bench)
    assert status == 0
    assert not told_apart(shown.shown, printed)
    exec(compile(proof.text, str(page), "exec"), names)  # noqa: S102 - our own page
    names["test_repeats_are_worth_something"]()


def test_a_page_that_shows_something_else_is_noticed():
    block = Block("page", "console", "$ bench runs\none\n…\nthree … four\n", "", 1)
    (command,) = commands(block)
    assert not told_apart(command.shown, "one\n2\n2\nthree and four  \n")
    assert told_apart(command.shown, "one\n2\nthree and five\n")
    assert told_apart(command.shown, "one\nthree and four\nmore\n")
    assert told_apart(["one"], "")
