"""Budgets with certificates of instruments, and with a learned stand."""

import datetime
import math
from dataclasses import replace

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.calibration import gls
from bench.calibration.budget.assessment import Simulation
from bench.calibration.budget.coefficients import make_budget, make_setup
from bench.calibration.budget.error_source import MEANS as SHARED
from bench.calibration.budget.sources import assumed_stand, bench_sources
from bench.calibration.design import make_problem
from bench.calibration.noise import KnownNoise, KnownStand
from bench.config.bench_file.file import load_bench, load_recorded_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from tests.support.certified_bench import HELD, certified, meter_certificate, table_certificate, write_bench
from tests.support.learned_file import CORRELATION, KINDS, MEANS, REMOUNT, SHIPPED, U

PLAN = load_procedure(find_procedure("paper")).expand()
HALF_A_YEAR = datetime.date(2026, 1, 1) + datetime.timedelta(days=183)
YEARS = 183 / 365.25
ALL = dict.fromkeys("xyz", meter_certificate("-12 ppm", "15 uV"))


def lines(bench, day=HALF_A_YEAR):
    return {source.name: source for source in bench_sources(bench, make_setup(PLAN, bench), day)}


def budget(bench, *names, day=HALF_A_YEAR, plan=PLAN):
    setup = make_setup(plan, bench)
    sources = bench_sources(bench, setup, day)
    stand = [source for source in sources if source.group == "stand" and source.u > 0]
    return make_budget(setup, [*stand, *(s for s in sources if s.name in names and s not in stand)])


def test_a_certificate_s_line_is_its_u_with_the_drift_since(tmp_path):
    """JCGM 100:2008, 4.3.3 and 4.3.7, and (G.2b) for the degrees of freedom, by hand."""
    found = lines(certified(tmp_path, meters=ALL))
    gain, offset = found["voltmeter_gain"], found["voltmeter_offset"]
    assert gain.u == pytest.approx(math.sqrt(3e-6**2 + (8e-6 * YEARS) ** 2 / 3))
    assert offset.u == pytest.approx(math.sqrt(5e-6**2 + (12e-6 * YEARS) ** 2 / 3))
    assert gain.dof == pytest.approx(20 * gain.u**4 / 3e-6**4)
    assert not gain.prior
    assert gain.origin == ("certificate C-1 of 2026-01-01: U = 6 ppm, k = 2; drift: 8 ppm/year in 0.5 years")


@pytest.mark.parametrize(
    ("days", "gain_limit", "offset_limit"),
    [(90, 20e-6, 50e-6), (91, 35e-6, 50e-6), (365, 35e-6, 50e-6), (730.5, 70e-6, 100e-6)],
)
def test_where_no_drift_is_stated_it_is_what_the_data_sheet_allows(tmp_path, days, gain_limit, offset_limit):
    """34401A User's Guide, chapter 8, the 10 V range: 20 + 5 ppm in 90 days, 35 + 5 ppm in a year."""
    bench = certified(tmp_path, meters=dict.fromkeys("xyz", meter_certificate(drift=False)))
    day = datetime.date(2026, 1, 1) + datetime.timedelta(days=days)
    found = lines(bench, day)
    assert found["voltmeter_gain"].u == pytest.approx(math.hypot(3e-6, gain_limit / math.sqrt(3)), rel=1e-3)
    assert found["voltmeter_offset"].u == pytest.approx(
        math.hypot(5e-6, offset_limit / math.sqrt(3)), rel=1e-3
    )
    assert found["voltmeter_gain"].prior


def test_meters_that_differ_have_lines_of_their_own(tmp_path):
    bench = certified(tmp_path, meters={"x": meter_certificate("-12 ppm", "15 uV", number="C-7")})
    found = lines(bench)
    assert "voltmeter_gain" not in found
    assert [found[f"voltmeter_gain[{c}]"].channels for c in "xyz"] == [("x",), ("y",), ("z",)]
    assert "C-7" in found["voltmeter_gain[x]"].origin
    assert found["voltmeter_gain[y]"].u == pytest.approx(20e-6 / math.sqrt(3))
    assert found["voltmeter_gain[y]"].prior
    assert "voltmeter_linearity" in found  # alike for all three

    names = [name for name in found if name.startswith(("voltmeter_gain", "voltmeter_offset"))]
    parts = budget(bench, *names)
    # a gain multiplies its channel's row of K, an offset adds to its bias: nothing else
    of_x = np.sqrt(sum(parts.contribution(n).u ** 2 for n in names if n.endswith("[x]")))
    K, g = parts.setup.block.K, found["voltmeter_gain[x]"].u
    assert of_x[:3] == pytest.approx(np.abs(K[0]) * g, rel=0.02, abs=1e-9)
    assert np.max(of_x[3:9]) < 1e-12
    assert of_x[9] == pytest.approx(
        math.hypot(found["voltmeter_offset[x]"].u, parts.setup.block.U0[0] * g), rel=0.02
    )


def test_lines_of_their_own_amount_to_the_one_line_of_meters_that_are_alike(tmp_path):
    one = budget(load_bench(find_bench("paper-stand")), "voltmeter_gain", "voltmeter_offset")
    alike = {c: meter_certificate(number=f"C-{c}") for c in "xyz"}
    each = certified(tmp_path, meters=alike)
    own = budget(each, *(name for name in lines(each) if name.startswith("voltmeter")))
    joint = budget(
        certified(tmp_path, meters=ALL), "voltmeter_gain", "voltmeter_offset", "voltmeter_linearity"
    )
    assert len(own.contributions) == len(joint.contributions) + 4
    assert np.allclose(own.combined.covariance, joint.combined.covariance, rtol=1e-9, atol=1e-22)
    own_scale = [0, 4, 8]
    assert np.all(joint.combined.u[own_scale] < one.combined.u[own_scale])


def test_what_the_bench_file_states_itself_overrides_the_certificate(tmp_path):
    stated = {"voltmeter_gain": {"limit": "4 ppm", "distribution": "normal", "k": 2}}
    found = lines(certified(tmp_path, meters={"x": meter_certificate()}, uncertainty=stated))
    assert found["voltmeter_gain"].u == pytest.approx(2e-6)
    assert not [name for name in found if name.startswith("voltmeter_gain[")]
    assert "voltmeter_offset[x]" in found


def test_gravity_with_its_source_is_its_line(tmp_path):
    gravity = {"value": "9.81054 m/s^2", "source": "survey", "date": "2024-02-01", "U": "2e-6 m/s^2", "k": 2}
    bench = certified(tmp_path, gravity={**gravity, "dof": 9})
    source = lines(bench)["gravity"]
    assert source.u * 9.81054 == pytest.approx(1e-6)
    assert (source.dof, source.prior) == (9, False)
    assert source.origin == "survey, 2024-02-01: U = 2e-06 m/s², k = 2"
    own = {"gravity": {"limit": "1e-5 m/s^2", "distribution": "normal", "k": 1}}
    overridden = lines(certified(tmp_path, gravity=gravity, uncertainty=own))["gravity"]
    assert overridden.u * 9.81054 == pytest.approx(1e-5)


def test_the_head_s_table_has_one_error_at_an_angle_however_often_it_is_there(tmp_path):
    table = table_certificate(dict.fromkeys(range(0, 360, 45), 1.0))
    bench = certified(tmp_path, head=table)
    source = lines(bench)["head_table"]
    assert source.u == pytest.approx(1.0 * ARCSEC)
    assert "head_table" not in lines(load_bench(find_bench("paper-stand")))
    quick = load_procedure(find_procedure("quick")).expand()
    once, thrice = (budget(bench, "head_table", plan=plan) for plan in (quick, PLAN))
    passes = {plan.name: len({step.pass_number for step in plan.steps if hasattr(step, "pass_number")})
              for plan in (quick, PLAN)}  # fmt: skip
    assert len(set(passes.values())) > 1
    by_table = [b.contribution("head_table").u for b in (once, thrice)]
    by_setting = [b.contribution("setting_error").u for b in (once, thrice)]
    assert np.max(by_setting[1]) < 0.75 * np.max(by_setting[0])
    assert np.max(by_table[1]) > 0.9 * np.max(by_table[0])


def test_the_error_of_the_thermometer_is_one_for_the_whole_run(tmp_path):
    row = {"temperature": "23 degC", "correction": "0.2 K", "U": "0.3 K", "k": 2, "dof": 8}
    bench = certified(tmp_path, chamber={**HELD, "values": [row]})
    source = lines(bench)["thermometer"]
    assert (source.u, source.dof, source.common) == (pytest.approx(0.15), 8, "run")
    u = budget(bench, "thermometer").contribution("thermometer").u
    # as a prior the bias moves by 30 µg/K, rectangular, and the scale by 180 ppm/K
    bias_v = 2.18 * 30e-6 / math.sqrt(3) * 0.15
    assert u[9] == pytest.approx(bias_v, rel=0.1)
    assert u[0] == pytest.approx(2.177 * 180e-6 / math.sqrt(3) * 0.15, rel=0.1)
    assert "thermometer" not in lines(load_bench(find_bench("paper-stand")))


def test_a_meter_whose_driver_is_not_here_is_taken_as_one_of_six_and_a_half_digits(tmp_path):
    text = write_bench(tmp_path, {"x": meter_certificate()}).read_text(encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(text.replace("agilent-34401a", "my-meter"), encoding="utf-8")
    unknown, known = load_recorded_bench(tmp_path / "mine.yaml"), load_bench(tmp_path / "certified.yaml")
    own, theirs = lines(unknown), lines(known)
    assert (
        own["voltmeter_gain[y]"].origin
        == "the driver my-meter is missing: assumed as a meter of 6½ digits on 10 V"
    )
    assert {name: source.u for name, source in own.items()} == {
        name: source.u for name, source in theirs.items()
    }


BENCH = load_bench(SHIPPED)
NOISE = KnownNoise(np.array([3e-5, 4e-5, 5e-5]), np.full(3, 80.0), 7e-6, 40.0)
KNOWN = KnownStand(
    tuple((kind, "") for kind in KINDS), MEANS, CORRELATION * np.outer(U, U),
    dict(zip(KINDS, REMOUNT.tolist(), strict=True)), NOISE,
)  # fmt: skip
BY_INSTALLATION = KnownStand(
    (("mounting_error", "1"), ("mounting_error", "2"), ("mounting_roll", "1")),
    MEANS[1:], KNOWN.covariance[1:, 1:], KNOWN.remount, None,
)  # fmt: skip


@pytest.fixture(scope="module")
def setup():
    return make_setup(load_procedure(find_procedure("paper")).expand(), BENCH)


def budget_of(setup, known):
    return make_budget(setup, bench_sources(BENCH, setup, known=known), known=known)


@pytest.mark.parametrize("known", [KNOWN, replace(KNOWN, noise=None), BY_INSTALLATION])
def test_its_u_is_that_of_a_fit_with_what_is_known(setup, known):
    """The posterior covariance of the fit that `bench calibrate` makes, its noise being the learned."""
    stated = {name: d.u for name, d in BENCH.stand_distributions().items()}
    sizes = stated | {name: d.u for name, d in assumed_stand(BENCH).items()}
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), sizes, known=known)
    noise = NOISE.given()
    if known.noise is None:
        noise = replace(
            noise, channels=None, reading=stated["voltmeter_error"], setting_rad=stated["setting_error"]
        )
    own = problem.predict(setup.block, problem.prior_mean)
    fit = gls.fit(problem, own, setup.block, noise)
    found = budget_of(setup, known).of_group("stand").covariance
    u = np.sqrt(np.diag(fit.covariance)[:12])
    np.testing.assert_allclose(found / np.outer(u, u), fit.covariance[:12, :12] / np.outer(u, u), atol=2e-3)


def test_it_is_smaller_than_by_the_limits_and_says_where_it_is_from(setup):
    limits, learned = budget_of(setup, None), budget_of(setup, KNOWN)
    assert np.all(learned.combined.u <= limits.combined.u)
    assert learned.of_group("stand").u[5] < limits.of_group("stand").u[5] / 3  # Kyz: the roll
    origins = {c.source.name: c.source.origin for c in learned.contributions}
    assert origins[SHARED] == "learned of the bench: means of all mountings"
    assert origins["mounting_error"] == "learned of the bench: what a remount adds"
    assert origins["voltmeter_error[y]"] == origins["setting_error"] == "learned of the bench"
    assert "voltmeter_error" not in origins


def test_monte_carlo_draws_what_hangs_together_so(setup):
    """Seed 3, 1,500 trials: variances within five standard errors of the linear ones."""
    budget = budget_of(setup, KNOWN)
    stand = replace(budget, contributions=tuple(c for c in budget.contributions if c.source.group == "stand"))
    drawn = Simulation(stand).readings(1500, np.random.default_rng(3)) - setup.signal
    spread = np.einsum("pni,tni->tp", budget.gain, drawn).std(axis=0)
    np.testing.assert_allclose(spread, stand.combined.u, rtol=5 / np.sqrt(2 * 1500))
