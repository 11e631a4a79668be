"""Until it is good enough: what is chosen of a plan, what no reading lowers, and that stopping keeps u true."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import CATALOGUE, ForwardModel
from bench.planning.choice import (
    REACHED,
    TIME,
    USED_UP,
    NoiseScale,
    Standing,
    scale_of,
    telling_apart,
    time_outlook,
)
from bench.planning.optimal_design import coefficient_goals
from bench.planning.pool import Reached, Visits, pool_of
from bench.services.errors import Refused
from bench.services.planning import stand_of
from bench.services.until import chooser_of
from benchmarks.until_campaign import World, run_until

PLAN = load_procedure(find_procedure("paper")).expand()
BENCH = load_bench(find_bench("paper-stand"))
VECTOR = ["vector=6.83e-5"]
"""What the closed form makes of the paper's 54 settings."""


@pytest.fixture(scope="module")
def chooser():
    return chooser_of(PLAN, BENCH, ["all=5e-5"])


def after(standing, choice, reached=(), scale=1.0):
    done = Counter(standing.done)
    done.update(p.site for p in choice.points)
    dof = max(3 * sum(done.values()) - 12, 1)
    return replace(
        standing,
        visit=choice.visit,
        taken=standing.taken | {p.steps[0] for p in choice.points},
        done=done,
        scale=NoiseScale(scale**2 * dof, dof),
        reached=reached,
    )


def test_the_pool_is_every_point_of_the_two_installations_and_no_verification_point():
    pool = pool_of(PLAN)
    assert [(v.mount.installation, len(v.points)) for v in pool.visits] == [("1", 27), ("2", 27)]
    assert pool.time_s == pytest.approx(PLAN.expected_duration_s())
    kinds = {PLAN.steps[i].key.split("/")[1] for p in pool.points for i in p.steps}
    assert kinds == {"turn", "wait", "read"}


def test_what_is_chosen_comes_once_a_site_and_ends_with_the_least_repeats(chooser):
    standing, settings = Standing(), 0
    while not (choice := chooser.choose(standing)).stop:
        assert len({p.site for p in choice.points}) == len(choice.points)
        assert not {p.steps[0] for p in choice.points} & standing.taken
        settings += len(choice.points)
        grid = chooser.task(after(standing, choice))
        found = Visits(grid.candidates, grid.goals, grid.done)
        u = np.sqrt(found.variances)
        told = zip(chooser.aim.wanted, u, strict=True)
        reached = tuple(Reached(w.name, s, w.goal.asked, w.goal.unit) for w, s in told)
        standing = after(standing, choice, reached if found.determined else ())
    assert choice.stop == REACHED
    assert choice.repeats >= 12
    assert 20 <= settings <= 32  # a plan that knows the noise needs 20


def test_the_same_record_gives_the_same_choice(chooser):
    again = chooser_of(PLAN, BENCH, ["all=5e-5"])
    first = after(Standing(), chooser.choose(Standing()))
    assert chooser.choose(first).to_json() == again.choose(first).to_json()


def test_what_was_refused_is_not_chosen_again(chooser):
    wanted = chooser.choose(Standing()).points[0].site
    refused = chooser.choose(Standing(refused=frozenset({wanted})))
    assert wanted not in {p.site for p in refused.points}
    first = chooser.pool.visits[0].mount
    elsewhere = chooser.choose(Standing(refused_mounts=frozenset({first})))
    assert {p.site.mount.installation for p in elsewhere.points} == {"2"}


def test_nothing_left_ends_the_run(chooser):
    everywhere = frozenset(v.mount for v in chooser.pool.visits)
    choice = chooser.choose(Standing(refused_mounts=everywhere))
    assert (choice.stop, choice.points) == (USED_UP, ())


def test_a_misfit_turns_to_the_sites_that_tell_apart_and_does_not_end(chooser):
    choice = chooser.choose(Standing())
    good = tuple(Reached(w.name, 0.1 * w.goal.asked, w.goal.asked, w.goal.unit) for w in chooser.aim.wanted)
    site = next(
        p.site for p in chooser.pool.visits[0].points if p.site not in {q.site for q in choice.points}
    )
    standing = replace(after(Standing(), choice, good), apart=frozenset({site}))
    turned = chooser.choose(standing)
    assert site in {p.site for p in turned.points}
    assert turned.telling_apart


@pytest.mark.slow
def test_new_orientations_tell_effects_apart_and_repeats_do_not(chooser):
    sites = sorted({p.site for p in chooser.pool.visits[0].points})
    at = [site.setting() for site in sites]
    best = telling_apart(
        chooser.stand, [at[0], at[2], at[4]] * 2, [at[0], at[1], at[5]], [*CATALOGUE.values()]
    )
    assert best[0] in (1, 2)
    assert 0 not in best


def test_a_time_alone_is_used_up_and_kept_to():
    chooser = chooser_of(PLAN, BENCH, ["time=3h"])
    standing, spent_s = Standing(), chooser.pool.always_s
    while not (choice := chooser.choose(standing)).stop:
        spent_s += choice.next_s
        standing = replace(after(standing, choice), elapsed_s=spent_s - chooser.pool.after_s)
    assert choice.stop == TIME
    assert 2.9 * 3600 < spent_s <= 3 * 3600


@pytest.mark.parametrize(
    ("goals", "said"),
    [
        (["all=1e-5"], "zero offset"),
        (["combined:Kyz=1e-4"], "mounting roll"),
        (["Kqq=3", "vector=abc"], "Kqq.*\n.*vector"),
        (["time=1h"], "too short"),
        (["combined:delta-g=1e-4"], "cancel in Δg"),
        ([" "], "no goal is stated; state one"),
    ],
)
def test_what_cannot_be_reached_is_refused_before_the_run(goals, said):
    with pytest.raises(Refused, match=said):
        chooser_of(PLAN, BENCH, goals)


def test_goals_of_both_uncertainties_stand_side_by_side():
    chooser = chooser_of(PLAN, BENCH, ["combined:Kyz=4e-4, vector=7e-5"])
    kyz = next(w for w in chooser.aim.wanted if w.combined)
    assert 3e-4 < np.sqrt(kyz.hidden) < 4e-4


def test_an_angle_that_nobody_stated_is_shown_by_the_mountings_that_show_it():
    """Kyz with α5 as large as the mounting error: 310 µV/g from 1 and 2 alone, a tenth of it with the remounts."""
    chooser = chooser_of(load_procedure(find_procedure("remount-90")).expand(), BENCH, ["combined:Kyz=1e-4"])
    assert np.sqrt(chooser.aim.wanted[0].hidden) < 2e-5
    end = chooser.choose(Standing()).end
    assert end is not None
    assert end.u <= 1e-4
    alone = stand_of(BENCH, ForwardModel(BENCH.installation_models()))
    promised = alone.promise(pool_of(PLAN).settings(), coefficient_goals({"Kyz": 1.0}))
    assert promised.goals[0].u(promised.readings) == pytest.approx(312e-6, rel=0.01)


def test_a_block_that_stays_mounted_for_four_series_shows_its_angles_once():
    """Kyz over switching on again has the u that α5 gives one mounting, not half of it; see above."""
    plan = load_procedure(find_procedure("turn-on")).expand()
    chooser = chooser_of(plan, BENCH, ["combined:Kyz=4e-4, vector=1e-3"])
    kyz = next(w for w in chooser.aim.wanted if w.combined)
    assert np.sqrt(kyz.hidden) == pytest.approx(312e-6, rel=0.01)
    with pytest.raises(Refused, match="mounting roll"):
        chooser_of(plan, BENCH, ["combined:Kyz=2e-4"])


def test_plans_without_a_choice_are_refused():
    with pytest.raises(Refused, match="sets temperatures"):
        chooser_of(load_procedure(find_procedure("temperature")).expand(), BENCH, ["all=5e-5"])


def test_the_noise_is_told_by_one_mounting_alone(chooser):
    points = list(chooser.pool.visits[0].points)
    found = [
        scale_of(chooser.stand, World.drawn(np.random.default_rng([3, n]), 2.0).measured(points))
        for n in range(40)
    ]
    assert {one.dof for one in found} == {3 * 27 - 9}
    # chi-square of 40 * 72 signals: a standard error of 2.6 % of the variance
    assert np.mean([one.chi2 / one.dof for one in found]) == pytest.approx(4.0, rel=0.1)


@pytest.mark.slow
def test_stopping_keeps_u_true_and_takes_two_fifths_of_the_papers_settings():
    chooser = chooser_of(PLAN, BENCH, VECTOR)
    ended = [run_until(chooser, World.drawn(np.random.default_rng([8, n]), 1.0)) for n in range(6)]
    assert all(one.reached for one in ended)
    assert np.mean([one.settings for one in ended]) <= 0.4 * 54
    # 12 correlated z in each of 6 runs: as good as 30 independent ones, a standard error of 0.13, three of them
    assert np.sqrt(np.mean([one.z**2 for one in ended])) == pytest.approx(1.0, abs=0.4)


@pytest.mark.slow
def test_the_outlook_is_a_distribution_of_time_and_settings():
    found = time_outlook(chooser_of(PLAN, BENCH, VECTOR), draws=30)
    low, mid, high = found.quantiles(found.time_s)
    assert low <= mid <= high < found.whole_s
    assert np.mean(found.reached) == 1.0
