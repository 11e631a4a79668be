"""Many runs as one system: one block or several, what all have and what one has alone."""

from dataclasses import replace

import numpy as np
import pytest

from bench.base.files import cache_folder
from bench.diagnosis import ThresholdCache, diagnose
from bench.diagnosis.linear import make_linear
from bench.diagnosis.multi_run_system import candidates_of, make_system, with_blocks
from bench.diagnosis.search import SearchTask, find_effects
from bench.model import CATALOGUE, AppliedEffect
from bench.readings.table import JoinedPart, together
from bench.validation.paper_bench import SETTING_U_RAD
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND_U, U0, K, OneThreshold, paper_run

LIMITS = {**STAND_U, "setting_error": SETTING_U_RAD}
SCALE = np.diag(K)


def runs(count, seed=1, **what):
    rng = np.random.default_rng(seed)
    return [paper_run(rng, **what) for _ in range(count)]


def joined(tables, blocks=None):
    return together(
        [JoinedPart(t, block=None if blocks is None else blocks[i]) for i, t in enumerate(tables)]
    )


def other_block(table, rng):
    """The readings as another block with other scale factors and zeros gives them."""
    change = 1.0 + rng.choice([-1, 1], 3) * rng.uniform(2e-3, 2e-2, 3)
    return replace(table, signal=table.signal * change + rng.normal(0.0, 0.05, 3))


@pytest.fixture(scope="module")
def cache():
    return ThresholdCache(cache_folder("thresholds"))


def test_one_system_of_one_block_has_twelve_coefficients_of_two_has_twenty_four():
    tables = runs(3)
    tables[2] = other_block(tables[2], np.random.default_rng(5))
    one = make_system(joined(tables[:2]), MODEL, STAND_U)
    assert one.fixed.shape == (len(one), 12)
    two = make_system(joined(tables, [0, 0, 1]), MODEL, STAND_U)
    assert two.fixed.shape == (len(two), 24)
    assert two.random.shape[1] == 3 * one.random.shape[1] // 2
    assert two.settings == 3 * 54
    # each block's rows are those of its own system
    alone = make_linear(tables[2], MODEL, STAND_U)
    np.testing.assert_allclose(two.response[-len(alone) :], alone.response, atol=1e-12)
    column = AppliedEffect(CATALOGUE["head_eccentricity"], {"cosine": np.array(1e-5)})
    np.testing.assert_allclose(
        two.effect_column(column)[-len(alone) :], alone.effect_column(column), rtol=1e-6
    )


def test_readings_tell_which_runs_are_of_one_block():
    tables = runs(4)
    rng = np.random.default_rng(6)
    assert with_blocks(joined(tables), MODEL).block is None
    mixed = [tables[0], other_block(tables[1], rng), tables[2], other_block(tables[3], rng)]
    told = with_blocks(joined(mixed), MODEL)
    assert [int(told.block[told.run == i][0]) for i in range(4)] == [0, 1, 0, 2]
    assert "these are 3 blocks" in told.notes[-1]
    # what is said is not doubted
    assert with_blocks(joined(mixed, [0, 0, 0, 0]), MODEL).block is None
    assert set(with_blocks(joined(tables, [0, 1, 2, 2]), MODEL).block) == {0, 1, 2}


def test_a_warm_up_begins_anew_with_every_run():
    system = make_system(joined(runs(2)), MODEL, STAND_U)
    column = system.effect_column(AppliedEffect(CATALOGUE["warm_up"], {"A": np.full(3, 1e-4)}))
    run = system.readings.run[system.rows.reading]
    np.testing.assert_allclose(column[run == 1], column[run == 0], atol=1e-7 * np.max(np.abs(column)))
    assert np.max(np.abs(column[run == 0])) > 0.5e-4 * np.min(np.abs(SCALE))


def test_a_step_at_a_remount_ends_with_its_run():
    system = make_system(joined(runs(2)), MODEL, STAND_U)
    step = AppliedEffect(CATALOGUE["turn_on_shift"], {"step": np.full(3, 1e-4)}, installations=("2",))
    column = system.effect_column(step)
    run = system.readings.run[system.rows.reading]
    assert np.any(column[run == 0])
    assert not np.any(column[run == 1])


@pytest.mark.slow
def test_many_runs_need_no_more_candidates_than_grow_with_their_number():
    """What one run alone may have (steps, single readings) is no candidate of all."""
    counts = []
    for number in (2, 4, 8):
        linear = make_system(joined(runs(number)), MODEL, STAND_U)
        counts.append(len(candidates_of(linear, NOISE_V).variants))
    assert counts[0] == counts[1] == counts[2]


@pytest.mark.slow
def test_what_is_too_small_for_one_run_shows_in_several_blocks():
    """Backlash of 6 arcsec in 4 blocks: rho of each about 4, of all about 8."""
    rng = np.random.default_rng(21)
    tables = [
        other_block(one, rng)
        for one in runs(4, 22, backlash_rad=np.radians(6 / 3600), directions=(1, -1, 1), noise_v=30e-6)
    ]
    assert diagnose(tables[0], MODEL, LIMITS, SCALE, OneThreshold()).effects == ()
    found = diagnose(joined(tables), MODEL, LIMITS, SCALE, OneThreshold())
    assert found.linear.fixed.shape[1] == 4 * 12
    assert [e.name for e in found.effects] == ["backlash"]
    (value,) = found.effects[0].parameters
    assert abs(value.value - 6.0) < 4 * value.u
    assert found.gap.after < found.gap.before


@pytest.mark.slow
def test_what_several_blocks_have_is_named_alone_and_no_form_competes_with_it():
    rng = np.random.default_rng(23)
    tables = runs(2, 24, backlash_rad=np.radians(60 / 3600), directions=(1, -1, 1))
    tables[1] = other_block(tables[1], rng)
    large_alone = OneThreshold(6.0, 0.006, 3.0, 0.05, 1.4, 2000)
    found = diagnose(joined(tables), MODEL, LIMITS, SCALE, large_alone)
    assert found.linear.readings.block is not None
    assert found.verdict == "named"
    assert [e.name for e in found.effects] == ["backlash"]
    assert found.form is None


@pytest.mark.slow
def test_zeros_that_change_between_runs_are_said_and_no_cause_is_made_up(cache):
    tables = runs(3, 31)
    rng = np.random.default_rng(32)
    tables = [replace(t, signal=t.signal + rng.normal(0.0, 100e-6, 3) * SCALE) for t in tables]
    found = diagnose(joined(tables), MODEL, LIMITS, SCALE, cache)
    assert found.verdict == "unknown"
    assert [e.name for e in found.effects] == ["zeros_by_run"]
    assert "do not say why" in found.effects[0].words


@pytest.mark.slow
def test_what_one_run_has_alone_is_found_in_it(cache):
    tables = runs(3, 41)
    late = (tables[2].installation == "2") & (tables[2].pass_number > 1)
    tables[2] = replace(tables[2], signal=tables[2].signal + np.where(late[:, None], [0, 2e-4, 0], 0))
    found = diagnose(joined(tables), MODEL, LIMITS, SCALE, cache)
    assert found.verdict != "agrees"
    assert found.effects[0].installations[:2] == ("1/3", "2/3")
    assert found.effects[0].channels == ("y",)


@pytest.mark.slow
@pytest.mark.parametrize("k2", [(0.0, 3e-4, 0.0), (2.5e-4,) * 3])
@pytest.mark.parametrize("kept", [["1"], ["V"]])
def test_a_run_that_does_not_determine_its_coefficients_can_be_joined(kept, k2):
    """The first run has one installation or verification points alone; the other determines what it leaves open."""
    whole, part = runs(2, seed=31, K2=k2)
    few = part.select(np.isin(part.installation, kept))
    found = diagnose(joined([few, whole]), MODEL, LIMITS, cache=OneThreshold())
    assert [one.name for one in found.effects] == ["quadratic_nonlinearity"]


def test_coefficients_of_several_blocks_are_each_its_own():
    tables = runs(2, 61)
    tables[1] = replace(tables[1], signal=tables[1].signal * 1.01 + 0.01)
    system = make_system(joined(tables, [0, 1]), MODEL, STAND_U)
    guesses = [np.diag(part.block.K) for part in system.parts]
    assert guesses[1] == pytest.approx(1.01 * guesses[0], rel=1e-3)
    assert pytest.approx(U0, abs=5e-3) == system.parts[0].block.U0


def noisier(table, rng, sizes):
    """The readings with more noise, of sizes (3,) in units of that which they have."""
    return replace(
        table, signal=table.signal + rng.normal(0.0, NOISE_V, table.signal.shape) * np.array(sizes)
    )


@pytest.mark.slow
def test_noise_of_each_channel_is_taken_as_it_is_in_several_runs(cache):
    """A third channel with three times the noise: nothing is missing."""
    rng = np.random.default_rng(12)
    tables = [noisier(table, rng, [0.0, 0.0, 3.0]) for table in runs(3, 13)]
    found = diagnose(joined(tables), MODEL, LIMITS, SCALE, cache)
    assert found.verdict == "agrees"
    x, y, z = found.noise_by_channel
    assert 2.4 < z / np.sqrt(x * y) < 4.0  # each of 100 and more degrees of freedom: known to a tenth


def test_an_effect_that_changes_between_repeats_leaves_the_noise_right():
    """Three runs (seed 94): their repeats scatter by more than the noise, as the temperature differs."""
    tables = []
    for run in runs(3, seed=94):
        warmth = 3.0 + 1.5 * np.sin(2 * np.pi * run.time_s / 5300.0)
        gain = np.outer(warmth, [0.0, 0.0, 60e-6])
        tables.append(replace(run, signal=run.signal + gain * (run.signal - U0), temperature_c=20.0 + warmth))
    task = SearchTask(MODEL, LIMITS, 0.0, OneThreshold())
    assert task.repeats(task.linear(joined(tables))).sigma > 1.5 * NOISE_V
    prepared, naming = find_effects(task, joined(tables))
    assert [one.variant.family for one in naming.found] == ["thermal_scale"]
    # with 450 degrees of freedom, u of the estimate is 3 %
    assert prepared.whitened.grid.sigma == pytest.approx(NOISE_V, rel=0.1)
