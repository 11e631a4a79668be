"""Series during which the block stayed mounted: their stand angles are the same ones.

What such an angle does to the readings is computed by the independent geometry of bench/validation/paper_bench.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import Noise, calibrate, gls
from bench.calibration.budget.assessment import Simulation
from bench.calibration.budget.coefficients import make_budget, make_setup
from bench.calibration.budget.sources import assumed_stand, bench_sources
from bench.calibration.design import make_problem
from bench.calibration.noise import KnownStand
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.diagnosis.linear import make_linear
from bench.model.geometry import COEFFICIENTS, STAND_ANGLES
from bench.readings.columns import MOUNTING
from bench.readings.table import JoinedPart, make_readings, together
from bench.validation.paper_bench import ARCSEC, SETTING_U_RAD, STAND_U, K, design, simulate, specific_force
from tests.support.honest_runs import MODEL

SERIES = 4
ROLL = {"mounting_roll": 30 * ARCSEC}
U = STAND_U | ROLL
ALPHA = {
    "axis_tilt": "alpha1",
    "zero_offset": "alpha2",
    "mounting_error": "alpha3",
    "mounting_roll": "alpha5",
}
READING_V = 1e-4
NOISE = Noise(READING_V, SETTING_U_RAD, np.inf, "given")
OTHER_RUNS = KnownStand(
    (("mounting_roll", ""), ("mounting_error", "1")),
    np.array([40.0, 10.0]) * ARCSEC,
    np.diag([5.0, 3.0]) ** 2 * ARCSEC**2,
    {"mounting_roll": 20 * ARCSEC, "mounting_error": 15 * ARCSEC},
)


def switched_on(numbers=(1,) * SERIES):
    """The paper's procedure in four series, without errors; `numbers` are the mountings of the series."""
    installation, pass_number, point, phi = design()
    n = len(phi)
    table = make_readings(
        installation * SERIES, pass_number * SERIES, point * SERIES, np.tile(phi, SERIES),
        np.tile(simulate(None, 0.0).signal, (SERIES, 1)), series=np.repeat(np.arange(SERIES) + 1, n),
    )  # fmt: skip
    cells = np.repeat(np.array([str(number or "") for number in numbers]), n)
    return replace(table, extra={MOUNTING: cells}) if any(numbers) else table


def by_the_book(readings, gain):
    """G V G^T: noise of each reading, and each stand angle once in an installation."""
    labels, phi = readings.installation.tolist(), readings.angle_rad

    def change(**angles):
        return (specific_force(labels, phi, **angles) - specific_force(labels, phi)) @ K.T

    flat = READING_V * gain.reshape(12, -1)
    along = np.einsum("pni,ni->pn", gain, change(alpha4=1e-4) / 1e-4) * SETTING_U_RAD
    whole = flat @ flat.T + along @ along.T
    for name, alpha in ALPHA.items():
        for label in "12":
            shift = change(**{alpha: np.where(readings.installation == label, U[name], 0.0)})
            part = np.einsum("pni,ni->p", gain, shift)
            whole += np.outer(part, part)
    return whole


@pytest.mark.parametrize("estimator", ["gls", "closed-form"])
def test_u_is_that_of_angles_which_all_series_share(estimator):
    readings = switched_on()
    found = calibrate(readings, MODEL, STAND_U, 9.81, estimator, NOISE, assumed_u=ROLL)
    book = by_the_book(readings, found.gain)
    size = np.outer(found.u, found.u)
    np.testing.assert_allclose(found.covariance / size, book / size, atol=2e-3)
    assert found.u[COEFFICIENTS.index("Kyz")] == pytest.approx(30 * 10.4e-6, rel=0.05)
    assert not [note for note in found.notes if "axis_tilt" in note]


@pytest.mark.parametrize("known", [None, OTHER_RUNS])
def test_u_is_that_of_one_series_with_a_quarter_of_the_variance(known):
    one = simulate(None, 0.0)
    quiet = replace(NOISE, reading=NOISE.reading / 2, setting_rad=NOISE.setting_rad / 2)
    whole, single = (
        calibrate(of, MODEL, STAND_U, 9.81, noise=noise, assumed_u=ROLL, known=known).covariance
        for of, noise in ((switched_on(), NOISE), (one, quiet))
    )
    u = np.sqrt(np.diag(single))
    np.testing.assert_allclose(whole / np.outer(u, u), single / np.outer(u, u), atol=2e-3)


def test_a_file_without_the_column_gives_what_it_gave():
    """Each series counts as a mounting: half of the u, and the note says what to state."""
    u = [
        calibrate(of, MODEL, STAND_U, 9.81, noise=NOISE, assumed_u=ROLL).u[COEFFICIENTS.index("Kyz")]
        for of in (switched_on((0,) * SERIES), switched_on((1, 2, 3, 4)), switched_on())
    ]
    assert u[0] == u[1]
    assert u[2] == pytest.approx(2 * u[0], rel=0.02)


def test_a_platform_levelled_once_for_two_mountings_is_told():
    found = calibrate(switched_on((1, 1, 2, 2)), MODEL, STAND_U, 9.81, noise=NOISE)
    told = [note for note in found.notes if "axis_tilt" in note]
    assert [note[:34] for note in told] == [f"installation {i} was mounted 2 times" for i in "12"]
    assert all("state 1.41 times axis_tilt and zero_offset" in note for note in told)
    assert not any("mounting_roll" in note for note in told)
    half = calibrate(switched_on((1, 1, 2, 0)), MODEL, STAND_U, 9.81, noise=NOISE)
    assert sum("has 3 series" in note and "mounting_roll" in note for note in half.notes) == 2


def test_what_a_level_measured_stays_as_it_is():
    columns = ("alpha1_arcsec", "alpha2_arcsec", "u_alpha1_arcsec", "u_alpha2_arcsec")
    table = switched_on()
    level = {name: np.where(table.series < 3, "1.5", "") for name in columns}
    conditions = replace(table, extra=table.extra | level).conditions()
    problem = make_problem(MODEL, conditions, U)
    measured = [j for j, unknown in enumerate(problem.stand) if unknown.measured]
    assert len(measured) == 2 * 2 * 2
    correlation = problem.hang @ problem.hang.T
    np.testing.assert_array_equal(correlation[measured], np.eye(len(problem.stand))[measured])
    for name, together_ in (("axis_tilt", 2), ("mounting_error", 4)):
        own = [j for j, s in enumerate(problem.stand) if STAND_ANGLES[s.column] == name and not s.measured]
        assert np.sum(correlation[np.ix_(own, own)] > 0.99) == 2 * together_**2


def test_the_diagnosis_expects_the_same_angles():
    """By the prior, equal settings in two series of one mounting are off by the same."""
    random = make_linear(switched_on(), MODEL, U).random
    per = len(random) // SERIES
    spread = np.einsum("kip,ljp->klij", *[random.reshape(SERIES, per, -1)] * 2)
    size = np.max(np.abs(spread))
    np.testing.assert_allclose(spread, np.broadcast_to(spread[0, 0], spread.shape), atol=1e-5 * size)


def test_joined_runs_keep_their_mountings_apart():
    both = together([JoinedPart(switched_on()), JoinedPart(switched_on())]).conditions()
    groups = [str(both.mounts[first]) for first in both.clamped]
    assert groups == ["1", "2", *["1", "2"] * 3, "1/5", "2/5", *["1/5", "2/5"] * 3]


BENCH = load_bench(find_bench("paper-stand"))


@pytest.fixture(scope="module")
def planned():
    return make_setup(load_procedure(find_procedure("turn-on")).expand(), BENCH)


@pytest.mark.parametrize("known", [None, OTHER_RUNS])
def test_the_budget_of_a_plan_is_the_u_of_its_calibration(planned, known):
    stated = {name: d.u for name, d in BENCH.stand_distributions().items()}
    sizes = stated | {name: d.u for name, d in assumed_stand(BENCH).items()}
    budget = make_budget(planned, bench_sources(BENCH, planned, known=known), known=known)
    fitted = planned.conditions.select(planned.fitted)
    assert len(set(planned.conditions.clamped.tolist())) == 3 < len(fitted.mounts)
    problem = make_problem(planned.model, fitted, sizes, known=known)
    noise = Noise(stated["voltmeter_error"], stated["setting_error"], np.inf, "given")
    fit = gls.fit(problem, problem.predict(planned.block, problem.prior_mean), planned.block, noise)
    u = np.sqrt(np.diag(fit.covariance)[:12])
    found = budget.of_group("stand").covariance
    np.testing.assert_allclose(found / np.outer(u, u), fit.covariance[:12, :12] / np.outer(u, u), atol=5e-3)
    trials = 1200
    drawn = Simulation(budget).outputs(trials, np.random.default_rng(8))[:, :9]
    ratio = drawn.std(axis=0, ddof=1) / budget.combined.u[:9]
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * trials))
