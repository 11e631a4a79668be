"""One list of estimators: each command takes the same ones, and says so."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import ESTIMATORS, calibrate
from bench.calibration.budget.coefficients import make_budget
from bench.calibration.estimators import GLS, find_estimator
from bench.calibration.gls import Estimator
from bench.readings.csv import write_csv
from tests.support.budget_bench import paper_setup, stand
from tests.support.honest_runs import MODEL
from tests.support.paper_bench import STAND_U, simulate


def half_of(task):
    """Fitted as by generalised least squares, and then only half of it believed: nonlinear as any other."""
    return replace(task.fit, gain=0.5 * task.fit.gain)


@pytest.fixture
def a_further_one(monkeypatch):
    monkeypatch.setitem(ESTIMATORS, "halved", Estimator("halved", "half of gls", half_of, also=("h",)))


def commands(readings):
    return (
        ("calibrate", readings, "--json", "-"),
        ("budget", "--procedure", "quick", "--trials", 0, "--json", "-"),
        ("require", "--accuracy", "3e-4", "--procedure", "quick", "--json", "-"),
    )


@pytest.fixture
def readings(tmp_path):
    write_csv(simulate(np.random.default_rng(5), 1e-4), tmp_path / "r.csv")
    return tmp_path / "r.csv"


@pytest.mark.slow
@pytest.mark.usefixtures("a_further_one")
def test_every_command_takes_every_estimator_by_each_of_its_names(bench, readings):
    for estimator in ESTIMATORS.values():
        for name in (estimator.name, *estimator.also):
            # another name for the same is looked up by one function: one command is enough
            for command in commands(readings)[: 3 if name == estimator.name else 1]:
                status, out, err = bench(*command, "--estimator", name)
                assert status < 2, (command, name, err)
                named = estimator.name if command[0] == "calibrate" else estimator.counts_as or estimator.name
                assert json.loads(out)["estimator"] == named
    assert find_estimator("h").name == "halved"


@pytest.mark.usefixtures("a_further_one")
def test_every_command_refuses_another_and_its_help_names_all(bench, readings):
    for command in commands(readings):
        status, _, err = bench(*command, "--estimator", "magic")
        assert status == 2
        assert "no estimator 'magic'; there are gls, closed-form, least-squares, robust, halved" in err
        _, out, _ = bench(command[0], "--help")
        told = " ".join(out.split())
        for estimator in ESTIMATORS.values():
            assert f"({estimator.phrase})" in told, estimator.name
        assert ("robust counts as gls" in told) == (command[0] != "calibrate")


@pytest.mark.usefixtures("a_further_one")
def test_a_nonlinear_one_has_the_budget_of_where_it_comes_to_rest():
    weighed, halved = (make_budget(paper_setup(), stand(), name) for name in (GLS, "halved"))
    np.testing.assert_allclose(halved.gain, 0.5 * weighed.gain, rtol=1e-12)
    robust = make_budget(paper_setup(), stand(), "robust")
    np.testing.assert_array_equal(robust.gain, weighed.gain)


def test_the_robust_estimator_has_the_map_of_generalised_least_squares_from_clean_readings():
    """What `counts_as` takes for granted, by the estimator itself, without an outlier and with one."""
    clean = simulate(np.random.default_rng(5), 1e-4)
    plain, robust = (calibrate(clean, MODEL, STAND_U, 9.81, name) for name in (GLS, "robust"))
    assert robust.outliers == ()
    np.testing.assert_array_equal(robust.covariance, plain.covariance)
    clean.signal[13, 1] += 0.05
    struck = calibrate(clean, MODEL, STAND_U, 9.81, "robust")
    assert len(struck.outliers) == 1
    assert not np.array_equal(struck.covariance, plain.covariance)


@pytest.mark.slow
def test_the_one_that_commands_take_unasked_is_listed_first(bench, readings):
    assert next(iter(ESTIMATORS)) == GLS
    for command in commands(readings):
        assert json.loads(bench(*command)[1])["estimator"] == GLS
