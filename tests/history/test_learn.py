"""Sizes of a bench from many runs, whose truth is of the tests' own making."""

import numpy as np
import pytest
from scipy import stats

from bench.calibration.calibrate import calibrate
from bench.calibration.result import CalibrationError
from bench.history.learning import learn
from bench.history.run_sums import run_fit
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, Installation
from tests.support.learning_bench import KINDS, STATED, Bench, simulate
from tests.support.paper_bench import ARCSEC

TURNED = {
    label: Installation.from_axes(label, axes)
    for label, axes in (
        ("1T90", ("y", "-x", "z")), ("2T90", ("-y", "z", "-x")),
        ("1T180", ("-x", "-y", "z")), ("2T180", ("x", "z", "-y")),
    )
}  # fmt: skip
MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2, **TURNED})
TRUTH = Bench(
    np.array([1.0, -1.2, 12.0, 9.0]) * ARCSEC, np.array([0.8, 1.2, 5.0, 6.0]) * ARCSEC,
    np.array([5e-5, 7e-5, 6e-5]), 2.5 * ARCSEC, np.array([3.0, -2.0, 1.5, 1.0]) * ARCSEC,
)  # fmt: skip


def fits(runs):
    return [run_fit(table.source, table, MODEL, STATED) for table in runs.tables()]


@pytest.fixture(scope="module")
def turned():
    """Seed 11: 14 runs, with quarter and half turns among them."""
    return simulate(np.random.default_rng(11), TRUTH, 14, turned=(0, 1, 2))


@pytest.fixture(scope="module")
def learned(turned):
    return learn(fits(turned), STATED)


def truth_of(name):
    kind, _, what = name.partition(".")
    if what == "mean":
        return TRUTH.means[KINDS.index(kind)] / ARCSEC
    if what == "remount":
        return TRUTH.remounts[KINDS.index(kind)] / ARCSEC
    if kind.startswith("noise"):
        return TRUTH.noise["xyz".index(kind[-2])]
    waves = dict(zip(("eccentricity.cosine", "eccentricity.sine", "ellipticity.cosine", "ellipticity.sine"),
                     TRUTH.waves / ARCSEC, strict=True))  # fmt: skip
    return {"setting_error": TRUTH.setting / ARCSEC}.get(name, waves.get(name.removeprefix("head_")))


def chance_of(size, truth):
    """Chance of a size as far off on either side: a mean by Student's t, a standard deviation by chi-square."""
    if size.name.startswith(("noise", "setting")) or size.name.endswith("remount"):
        below = stats.chi2.cdf(size.dof * (size.value / truth) ** 2, size.dof)
    else:
        below = stats.t.cdf((size.value - truth) / size.u, size.dof)
    return 2 * min(below, 1 - below)


def test_no_size_is_further_from_its_truth_than_its_u_and_dof_allow(learned):
    """Of the sizes told none is less likely than 1 % shared out among them (Bonferroni), by the dof each states.

    Fourteen runs leave the remount of the zero offset with the mounting error's: it keeps its prior. That of the
    tilt, half of what was stated and less than the setting error, has few degrees of freedom: its upper end alone.
    """
    found = [size for size in learned.sizes() if not size.name.startswith("drift")]
    assert len(found) == 4 + 4 + 4 + 4
    assert [size.name for size in found if not size.told] == ["zero_offset.remount"]
    assert [size.name for size in found if size.dof <= 4] == ["axis_tilt.remount"]
    told = [size for size in found if size.told]
    for size in told:
        assert chance_of(size, truth_of(size.name)) > 0.01 / len(told), size
    assert learned.shown_waves() == [0, 1]
    assert not learned.contradicting


def test_what_installations_1_and_2_do_not_tell_keeps_its_prior():
    """Seed 12: the roll shows in neither, the zero offset only beside the mounting error."""
    found = learn(fits(simulate(np.random.default_rng(12), TRUTH, 8)), STATED)
    untold = {size.name: size for size in found.sizes() if not size.told}
    assert {"mounting_roll.mean", "mounting_roll.remount", "zero_offset.remount"} <= set(untold)
    total = found.known.covariance[3, 3] + found.known.remount["mounting_roll"] ** 2
    assert total == pytest.approx(STATED["mounting_roll"] ** 2, rel=0.01)
    assert any("no reading of these runs shows it" in sentence for sentence in found.not_identified())
    assert any("only together with mounting_error" in sentence for sentence in found.not_identified())
    assert any("absolute gain" in sentence for sentence in found.not_identified())


def test_with_means_of_their_own_installations_tell_less(turned):
    """The roll of installation 1 and that of 2 are in Kyz and Kzy, and are told by the turns alone."""
    found = learn(fits(turned), STATED, by_installation=True)
    assert len(found.keys) == 4 * 6
    assert found.names[0] == "axis_tilt[1]"


@pytest.mark.parametrize(
    ("own", "what"), [({"K2": {3: 1.5e-4}}, "leaves"), ({"drift": {3: 1.2e-3}}, "leaves")]
)
def test_what_one_block_has_is_named_and_not_charged_to_the_bench(own, what):
    """Seed 13: run 4 alone has K2, or a bias that runs away."""
    with_it = learn(fits(simulate(np.random.default_rng(13), TRUTH, 10, **own)), STATED)
    assert [one.run for one in with_it.contradicting] == ["run-4"]
    assert "run-4" not in with_it.runs
    without = fits(simulate(np.random.default_rng(13), TRUTH, 10))
    without = learn([run for run in without if run.name != "run-4"], STATED)
    for one, other in zip(with_it.sizes(), without.sizes(), strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-3, abs=1e-7)


def test_a_run_on_another_stand_contradicts_by_its_angles():
    """Seed 14: run 1 has its block mounted 5 arcmin off."""
    off = Bench(
        TRUTH.means + np.array([0, 0, 300, 0]) * ARCSEC,
        TRUTH.remounts,
        TRUTH.noise,
        TRUTH.setting,
        TRUTH.waves,
    )
    one = fits(simulate(np.random.default_rng(14), off, 1))
    rest = fits(simulate(np.random.default_rng(15), TRUTH, 10))[1:]
    found = learn([*one, *rest], STATED)
    assert [c.run for c in found.contradicting] == ["run-1"]
    assert found.contradicting[0].what == "its angles of the stand"


def test_the_next_calibration_takes_it_and_its_u_is_smaller(turned, learned):
    """Seed 16, one run more: u of Kyz, most of it the roll's, falls to a third at most, and holds the truth."""
    new = simulate(np.random.default_rng(16), TRUTH, 1)
    (table,) = new.tables()
    stated_u = {name: u for name, u in STATED.items() if name != "mounting_roll"}
    roll = {"mounting_roll": STATED["mounting_roll"]}
    before = calibrate(table, MODEL, stated_u, 9.81, assumed_u=roll, find_shared=False)
    after = calibrate(table, MODEL, stated_u, 9.81, assumed_u=roll, find_shared=False, known=learned.known)
    assert np.all(after.u < 1.2 * before.u)  # the noise of all runs in place of that of this one
    assert after.u[5] < before.u[5] / 3
    z = (after.block.vector - new.truths[0]) / after.u
    assert np.max(np.abs(z)) < 4
    assert after.stand["alpha5[1]"].value == pytest.approx(9.0, abs=4 * 7)
    # the learned roll is no assumption any more: it stands in what the readings and the stand show
    np.testing.assert_allclose(after.covariance_readings, after.covariance)


def test_too_few_runs_and_repeats_are_refused(turned):
    runs = fits(turned)
    with pytest.raises(CalibrationError, match="1 run tells nothing"):
        learn(runs[:1], STATED)
    alone = fits(simulate(np.random.default_rng(17), TRUTH, 2, passes=1))
    with pytest.raises(CalibrationError, match="too few repeats"):
        learn(alone, STATED)
