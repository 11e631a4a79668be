"""The names of `import bench`: there, lazy, not hidden by a room; what is no argument of theirs is refused."""

import ast
import inspect
import pkgutil
import subprocess
import sys
from datetime import date
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import bench
from bench.cli.commands import COMMANDS, load_command
from bench.services.arguments import kinds_of
from bench.services.requests.evaluation import Learn
from bench.services.requests.measuring import DryRunRequest

HEAVY = ("numpy", "scipy", "pydantic", "matplotlib", "pandas", "rich", "importlib.metadata")
IMPORTS = f"""
import sys

def light(what):
    found = [name for name in {HEAVY} if name in sys.modules]
    assert not found, (what, found)

import bench
light("import bench")
assert "typer" not in sys.modules
from bench.cli.app import main
try:
    main(["--help"])
except SystemExit:
    light("the help")
from bench.cli.commands import COMMANDS, load_command
for name in COMMANDS:
    load_command(name)
    light(name)
"""


@pytest.mark.slow
def test_neither_the_package_nor_the_help_nor_a_command_that_has_not_begun_imports_anything_heavy():
    """What is imported is told by a fresh interpreter, one step after the other."""
    command = [sys.executable, "-c", IMPORTS]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own words


def test_the_list_of_commands_says_what_each_says_itself():
    for name, line in COMMANDS.items():
        command = load_command(name)
        assert (command.name, command.help.splitlines()[0]) == (name, line)


def test_every_public_name_is_what_it_was_when_every_module_is_imported():
    before = {name: getattr(bench, name) for name in bench.__all__}
    for module in pkgutil.walk_packages(bench.__path__, "bench."):
        import_module(module.name)
    assert {name: getattr(bench, name) for name in bench.__all__} == before
    assert dir(bench) == sorted(bench.__all__)
    assert all(value.__doc__ for value in before.values())


def test_a_type_checker_is_told_the_same_names_from_the_same_modules():
    tree = ast.parse(Path(bench.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    told = [(one.module, name) for one in block.body if one.module != "typing" for name in one.names]
    assert all(name.asname == name.name for _, name in told)
    assert sorted((home, name.name) for home, name in told) == sorted(
        (home, name) for home, names in bench._HOMES.items() for name in names
    )


def test_an_unknown_name_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'calibration_of'"):
        bench.calibration_of  # noqa: B018 - the look-up is what is tested


READINGS = str(Path(__file__).parents[1] / "data" / "records" / "readings.csv")
FUNCTIONS = {
    name: getattr(bench, name) for name in bench.__all__ if not inspect.isclass(getattr(bench, name))
}
PARAMETERS = [
    (function, parameter)
    for function in FUNCTIONS
    for parameter in inspect.signature(FUNCTIONS[function]).parameters
]
NEVER = [object(), b"x", {}, [object()], float("nan"), 10**400, "\0", "\ud800", "x" * 5000, 3 + 4j]
"""What no parameter takes."""


@pytest.mark.parametrize(("function", "parameter"), PARAMETERS, ids=".".join)
def test_what_no_parameter_takes_is_refused_in_a_sentence(function, parameter):
    needed = {
        name: KINDS_OF_GOOD[name]
        for name, one in inspect.signature(FUNCTIONS[function]).parameters.items()
        if one.default is inspect.Parameter.empty and name != parameter
    }
    for value in NEVER:
        with pytest.raises(bench.Refused) as refused:
            FUNCTIONS[function](**{**needed, parameter: value})
        text = str(refused.value)
        assert text.startswith(f"{parameter}=")
        assert ": expected " in text
        assert len(text) < 300
        assert "\n" not in text


KINDS_OF_GOOD = {"source": "none.csv", "sources": ["none.csv"], "model": "none.yaml", "procedure": "none",
                 "bench": "none", "readings": "none.csv", "record": "none.csv", "plan": "none.yaml",
                 "results": ["Q7FA=none.json"], "laboratory": ["Kyiv", "Graz", "Brno"]}  # fmt: skip


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: bench.calibrate(5), "source=5: expected a readings file"),
        (lambda: bench.calibrate(READINGS, g="9.8"), "g='9.8': expected a number"),
        (lambda: bench.calibrate(READINGS, g=9), "between 9.75 and 9.85"),
        (lambda: bench.calibrate(READINGS, skip_bad_rows="no"), "skip_bad_rows='no': expected True or False"),
        (lambda: bench.dry_run("paper", seed=-1), "seed=-1: expected a whole number, 0 or more"),
        (lambda: bench.dry_run("paper", seed=True), "seed=True: expected a whole number"),
        (lambda: bench.budget(trials="many"), "trials='many': expected a whole number"),
        (lambda: bench.verify(READINGS, population=(1e-4,)), "population=.*: expected a pair of numbers"),
        (lambda: bench.learn("readings.csv"), "sources='readings.csv': expected a list"),
        (lambda: bench.learn([]), r"sources=\[\]: expected a list"),
        (lambda: bench.diagnose([]), r"source=\[\]: expected"),
        (lambda: bench.chart([]), r"runs=\[\]: expected runs"),
        (lambda: bench.learn([READINGS], expires="2030-01-01"), "expires='2030-01-01': expected a date"),
    ],
)
def test_what_is_wrong_is_named(call, says):
    with pytest.raises(bench.Refused, match=says):
        call()


def test_what_fits_is_passed_on():
    """Numbers of numpy are numbers, and a date of datetime is one."""
    kinds = {**kinds_of(DryRunRequest), **kinds_of(Learn)}
    assert kinds["g"][0](np.float64(9.81))
    assert kinds["seed"][0](np.int64(3))
    assert kinds["expires"][0](date(2030, 1, 1))
    assert kinds["bench"][0](Path("paper-stand"))


def test_what_the_file_system_refuses_is_a_sentence():
    with pytest.raises(bench.Refused, match="File name too long"):
        bench.calibrate("x" * 3000)
