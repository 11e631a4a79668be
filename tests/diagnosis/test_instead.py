"""A name is none where something without a name explains the readings as well: in its place, or beside it."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.naming import Found, Naming
from bench.diagnosis.residual_model import unnamed_in_place
from tests.support.diagnosis_bench import paper_run, set_up
from tests.support.paper_bench import SETTING_U_RAD, U0, K


def suspects(volts_of, family, channels=None):
    """Which of the finds a form may replace; `volts_of` says by run and force (n, 3) what is hidden in the run."""
    run = paper_run(np.random.default_rng(17))
    force = np.linalg.solve(K, (run.signal - U0).T).T
    ready = set_up(replace(run, signal=run.signal + volts_of(run, force)))
    variant = next(
        v
        for v in ready.candidates.variants
        if v.family == family and (channels is None or v.channels == channels)
    )
    naming = Naming((Found(variant, 0.0, 0.0, 0.0),), -1.0)
    data = ready.whitened.reduce(ready.linear.response[:, None])
    return unnamed_in_place(ready.linear, ready.whitened, data, naming, (), SETTING_U_RAD)


def in_z(course):
    return course[:, None] * np.array([0.0, 0.0, K[2, 2]])


@pytest.mark.slow
def test_a_square_is_a_square():
    assert suspects(lambda _, a: in_z(60e-6 * a[:, 2] ** 2), "quadratic_nonlinearity", (2,)) == ()


@pytest.mark.slow
def test_a_fourth_power_is_none():
    assert suspects(lambda _, a: in_z(150e-6 * a[:, 2] ** 4), "quadratic_nonlinearity", (2,)) == (0,)


@pytest.mark.slow
def test_what_is_left_beside_a_name_speaks_against_it():
    def hidden(run, a):
        return in_z(60e-6 * a[:, 2] ** 2 + 60e-6 * np.sin(run.angle_rad / 2))

    assert suspects(hidden, "quadratic_nonlinearity", (2,)) == (0,)
