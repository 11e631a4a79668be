"""Included files: regular, few, read once, and nothing quoted of a file that is no procedure."""

import os

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.procedure import load as load_module
from bench.config.procedure.check import check
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench
from bench.run.sentences import duration

HEAD = "procedure: x\nsteps:\n"
WAIT = "steps: [{wait: {for: 1 s}}]\n"


@pytest.fixture
def told(tmp_path):
    """Return a function that loads a procedure of these steps and returns what is wrong with it."""

    def load(steps: str) -> str:
        (tmp_path / "p.yaml").write_text(HEAD + steps, encoding="utf-8")
        try:
            return f"{len(load_procedure(tmp_path / 'p.yaml').plan.steps)} steps"
        except FileMistakes as error:
            return str(error)

    return load


def test_doubling_includes_are_read_once_and_end(told, tmp_path):
    for k in range(40):
        (tmp_path / f"d{k}.yaml").write_text(
            f"steps: [{{include: d{k + 1}.yaml}}, {{include: d{k + 1}.yaml}}]\n"
        )
    (tmp_path / "d40.yaml").write_text(WAIT)
    assert told("- include: d30.yaml\n") == "1024 steps"


def test_doubling_without_end_is_told(told, tmp_path, monkeypatch):
    assert load_module.MOST_STEPS == 200_000
    monkeypatch.setattr("bench.config.procedure.load.MOST_STEPS", 2000)
    test_doubling_includes_are_read_once_and_end(told, tmp_path)
    assert "more than 2000 steps; check its repeats, counts and includes" in told("- include: d0.yaml\n")


@pytest.mark.parametrize(
    "secret",
    ["password: geheim\n", "geheim:x:0:0\ngeheim: y\n", "a: &geheim [*geheim2]\n", "- geheim\n", "\xff"],
)
def test_nothing_is_quoted_of_what_is_no_procedure(told, tmp_path, secret):
    (tmp_path / "s.yaml").write_bytes(secret.encode("latin-1"))
    answer = told("- include: s.yaml\n")
    assert "s.yaml" in answer
    assert "geheim" not in answer
    assert "password" not in answer
    (tmp_path / "p.yaml").write_text(secret, encoding="utf-8")
    with pytest.raises(FileMistakes) as refused:
        load_procedure(tmp_path / "p.yaml")
    assert "password" not in str(refused.value)


def test_what_is_no_file_of_a_procedure_is_not_opened(told, tmp_path):
    (tmp_path / "passwd").write_text("geheim:x:0:0\n")
    (tmp_path / "link.yaml").symlink_to("passwd")
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "dir.yml").mkdir()
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    (tmp_path / "big.yaml").write_text(WAIT + "#" * 1_000_000)
    for name, why in (
        ("passwd", "ends with .yaml or .yml"),
        ("link.yaml", "ends with .yaml or .yml"),
        ("loop.yaml", "symbolic links"),
        ("pipe.yaml", "a pipe, not a file"),
        ("dir.yml", "this is a folder"),
        ("zero.yaml", ".yaml or .yml"),
        ("big.yaml", "more than 1 MB"),
        ('"a\\0b.yaml"', "there is no such file"),
    ):
        answer = told(f"- include: {name}\n")
        assert why in answer
        assert "geheim" not in answer
        assert len(answer.splitlines()) == 1


def test_so_many_files_and_no_more(told, tmp_path, monkeypatch):
    assert load_module.MOST_FILES == 1000
    monkeypatch.setattr(load_module, "MOST_FILES", 30)
    for k in range(31):
        (tmp_path / f"n{k}.yaml").write_text(WAIT)
    lines = [f"- include: n{k}.yaml\n" for k in range(31)]
    assert told("".join(lines[:30])) == "30 steps"
    assert "more than 30 files are included" in told("".join(lines))


def test_includes_and_steps_are_not_endlessly_deep(told, tmp_path):
    inside = 20
    for k in range(120):
        (tmp_path / f"c{k}.yaml").write_text(f"steps: [{{include: c{k + 1}.yaml}}]\n")
        deep = "repeat: {times: 1, steps: [{" * inside + f"include: e{k + 1}.yaml" + "}]}" * inside
        (tmp_path / f"e{k}.yaml").write_text(f"steps: [{{{deep}}}]\n")
    assert "nested more than 100 levels deep" in told("- include: c0.yaml\n")
    (tmp_path / "c95.yaml").write_text(WAIT)
    assert told("- include: c0.yaml\n") == "1 steps"
    (tmp_path / "e95.yaml").write_text(WAIT)
    assert "nested too deeply" in told("- include: e0.yaml\n")


def test_a_file_of_mistakes_tells_a_page_of_them(told):
    answer = told("- {wiat: {for: 1 s}}\n" * 5000).splitlines()
    assert len(answer) == 200
    assert "more mistakes follow" in answer[-1]


@pytest.mark.parametrize(
    "step", ["wait: {for: 1e308 s}", "repeat: {times: 400, steps: [{wait: {for: 1 d}}]}"]
)
def test_a_procedure_ends_within_a_year(tmp_path, step):
    (tmp_path / "p.yaml").write_text(f"procedure: x\nsteps: [{{{step}}}, {{{step}}}]\n")
    plan = load_procedure(tmp_path / "p.yaml").plan
    (told,) = check(plan, load_bench(find_bench("paper-stand")))
    assert "more than 366 days" in told
    assert duration(plan.expected_duration_s())


def test_settling_takes_no_million_samples(told):
    settle = "{what: signals, precision: 1 mV, window: 1 s, timeout: 1e308 s, interval: 1e-9 s}"
    assert "more than 1000000 samples until the timeout; change one of the two" in told(
        f"- settle: {settle}\n"
    )
