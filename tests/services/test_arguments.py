"""Public functions given what is no argument of theirs: one sentence each, whatever it is."""

import inspect
from datetime import date
from pathlib import Path

import numpy as np
import pytest

import bench
from bench.services.arguments import kinds_of
from bench.services.requests.history import Learn
from bench.services.requests.measuring import DryRunRequest

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
