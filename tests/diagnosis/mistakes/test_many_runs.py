"""Mistakes in several joined runs: each is looked for, named and put right in its own run."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.linear import make_linear
from bench.diagnosis.mistakes import search
from bench.diagnosis.multi_run_system import find_mistakes_in_each, make_system, with_blocks
from bench.diagnosis.noise_grid import make_whitener
from bench.readings.table import JoinedPart, Readings, together
from bench.validation.paper_bench import STAND_U
from tests.support.mistaken_runs import MODEL, NOISE_V, NOMINAL, run, with_outlier, with_signal


def joined(tables: list[Readings]) -> Readings:
    return together([JoinedPart(table) for table in tables])


def every(table: Readings) -> np.ndarray:
    return np.ones(len(table), dtype=bool)


@pytest.mark.slow
def test_each_mistake_is_named_with_its_run_and_put_right():
    good = [run([81, number]) for number in range(3)]
    swapped = with_signal(good[1], every(good[1]), lambda signal: signal[:, [1, 0, 2]])
    readings = joined([good[0], swapped, with_outlier(good[2], 40, 0, 2e-3)])
    found = find_mistakes_in_each(readings, MODEL, STAND_U, NOMINAL)
    assert [mistake.name for mistake in found.mistakes] == ["swapped_channels", "outlier"]
    exchanged, outlier = found.mistakes
    assert set(exchanged.installations) == {
        str(m) for m in joined(good).select(readings.run == 1).oriented().conditions().mounts
    }
    assert exchanged.words.startswith("series ")
    assert (outlier.pass_number, outlier.point) == (good[2].pass_number[40], good[2].point[40])
    expected = np.concatenate([good[0].signal, good[1].signal, np.delete(good[2].signal, 40, axis=0)])
    np.testing.assert_array_equal(found.corrected.signal, expected)
    assert len(found.corrected.skipped) == 1
    # put right it is the block that the others are of
    assert with_blocks(readings, MODEL).block is not None
    assert with_blocks(found.corrected, MODEL).block is None


@pytest.mark.slow
def test_runs_without_a_mistake_are_returned_as_they_are():
    # five runs share 1e-4
    readings = joined([run([82, number]) for number in range(5)])
    found = find_mistakes_in_each(readings, MODEL, STAND_U, NOMINAL)
    assert found.mistakes == ()
    assert found.corrected is readings


def test_a_run_that_does_not_determine_its_block_goes_with_one_that_does():
    good = [run([83, number]) for number in range(2)]
    half = good[1].select(good[1].installation == "1")
    found = find_mistakes_in_each(joined([good[0], with_outlier(half, 5, 2, 3e-3)]), MODEL, STAND_U, NOMINAL)
    (mistake,) = found.mistakes
    assert (mistake.name, mistake.point) == ("outlier", half.point[5])


def test_no_table_of_suppositions_is_larger_than_a_run(monkeypatch):
    """The memory of twenty runs is that of one: 550 MB were those of all together."""
    sizes = []
    of_one = search.find_mistakes

    def noted(readings, *given):
        sizes.append(len(readings))
        return of_one(readings, *given)

    monkeypatch.setattr("bench.diagnosis.multi_run_system.find_mistakes", noted)
    tables = [run([84, number]) for number in range(3)]
    find_mistakes_in_each(joined(tables), MODEL, STAND_U, NOMINAL)
    assert sizes == [len(table) for table in tables]


def test_what_all_runs_share_joins_no_block_larger_than_a_run():
    """An effect in one channel of all runs is a third of the rows: one dense block of them took 40 of 67 s."""
    system = make_system(joined([run([85, number]) for number in range(6)]), MODEL, STAND_U)
    alone = make_linear(run([85, 0]), MODEL, STAND_U)
    bias = (system.rows.channel == 0)[:, None] * NOISE_V
    shared = replace(system, random=np.concatenate([system.random, bias], axis=1))
    whitener = make_whitener(shared, NOISE_V, 1e-5)
    assert max(factor.shape[1] for _, factor in whitener.blocks) <= len(alone)
