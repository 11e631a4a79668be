"""What to measure next: the worth of a further run is known before it, and what is proposed can be carried out."""

import io
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from scipy.linalg import subspace_angles

from bench.cli import measure
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.diagnosis import diagnose
from bench.diagnosis.linear import make_linear
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.next_measurement import (
    MENU,
    Chance,
    Proposal,
    answers,
    following,
    planned_readings,
    propose,
)
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.visibility import EffectPart, ReadingDesign, forms_everywhere
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.results.diagnosis import ProposalPart
from bench.results.diagnosis_words import surer_in_words
from bench.run.folder import Run
from bench.services.requests.measuring import RunRequest
from bench.validation import paper_bench
from tests.support.diagnosis_bench import OneThreshold

BENCH = load_bench(find_bench("paper-stand"))
MODEL = ForwardModel(BENCH.installation_models())
BLOCK = BENCH.simulated_block()
STAND_U = {name: d.u for name, d in BENCH.stand_distributions().items() if name != "voltmeter_error"}
NOISE = NoiseSize(15e-6, STAND_U["setting_error"], 42)


def plan_of(name):
    return load_procedure(find_procedure(name)).plan


def papers_settings():
    """The paper's 54 settings, all rising, without its verification points."""
    planned = planned_readings(plan_of("paper"), MODEL, BLOCK)
    return planned.select(planned.installation != "V")


def design(*names):
    readings = papers_settings()
    for name in names:
        readings = following(readings, plan_of(name), MODEL, BLOCK, 50.0)
    return ReadingDesign(make_linear(readings, MODEL, STAND_U), NOISE)


# --- planned readings -------------------------------------------------------------------------------

SHORT = """\
procedure: short
title: a little of everything
reading: {samples: 2, nplc: 1, settle: 1 s}
operator_time: {turn: 2 min, mount: 20 min, input: 1 min}
steps:
  - installation:
      label: 2
      steps:
        - repeat:
            directions: [rising, falling]
            scans: [xyz, zyx]
            steps:
              - input: {source: short}
              - turn: {angles: {from: 0 deg, step: 90 deg, count: 4}}
  - installation: {label: V, steps: [{turn: {angles: [45 deg]}}]}
  - input: {source: reference, voltage: -2 V}
"""


@pytest.mark.slow
def test_what_is_planned_is_what_a_run_then_gives(bench, tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    status, _, _ = bench("run", path, "--dry-run", "--name", "a")
    assert status == 0
    run = Run(tmp_path / "runs" / "a")
    measured = run.readings()
    planned = planned_readings(run.plan, MODEL, BLOCK, temperature_c=23.0)
    assert len(planned) == 12
    for name in ("installation", "series", "pass_number", "point", "direction", "samples"):
        assert np.array_equal(getattr(planned, name), getattr(measured, name)), name
    assert measured.extra["reference_v"].tolist() == [""] * 11 + ["-2.0"]
    np.testing.assert_array_equal(planned.extra["reference_v"], measured.extra["reference_v"])
    np.testing.assert_allclose(planned.target_rad, measured.target_rad, atol=1e-9)
    np.testing.assert_allclose(planned.temperature_c, measured.temperature_c)
    # 90″ of mounting error are 1 mV, a slip of the operator 10′ at most; a turn takes 1 to 3 min
    np.testing.assert_allclose(planned.signal, measured.signal, atol=7e-3)
    np.testing.assert_allclose(np.diff(planned.time_s), np.diff(measured.time_s), rtol=0.6, atol=60.0)


def test_a_further_run_stands_behind_the_readings_as_visits_of_its_own():
    both = following(papers_settings(), plan_of("return"), MODEL, BLOCK, 50.0)
    labels = list(dict.fromkeys(zip(both.series.tolist(), both.installation.tolist(), strict=True)))
    assert labels == [(1, "1"), (1, "2"), (2, "1"), (2, "2"), (2, "V"), (3, "1")]
    assert np.all(np.diff(both.time_s) > 0)


# --- how far apart ----------------------------------------------------------------------------------


def part(family, parameter, channel=None, mounts=(), **shape):
    return EffectPart(family, parameter, tuple(shape.items()), mounts, channel)


def all_channels(family, parameter):
    return tuple(part(family, parameter, channel) for channel in range(3))


TIES = [
    (part("backlash", "play"), (part("zero_offset", "angle"),), ("calibration",), 10),
    (part("cubic_nonlinearity", "K3", 1), (part("odd_quadratic_nonlinearity", "Koq", 1),), ("turn-12",), 40),
    (
        part("turn_on_shift", "step", 2, ("2",)),
        (part("bracket_tilt", "angle", None, ("2",)),),
        ("return", "remount-180"),
        10,
    ),
    (
        part("mounting_error", "angle", None, ("1",)),
        (part("mounting_offset", "angle", None, ("2",)),),
        ("remount-180",),
        10,
    ),
    (part("head_ellipticity", "sine"), all_channels("cubic_nonlinearity", "K3"), ("remount-90",), 10),
    (
        part("axis_wobble", "sine", harmonic=2.0),
        all_channels("cross_coupling", "Kpo")[1:],
        ("remount-90",),
        10,
    ),
    (part("voltmeter_drift", "rate"), all_channels("bias_drift", "rate"), ("inputs",), 10),
    (
        part("voltmeter_nonlinearity", "q2"),
        all_channels("quadratic_nonlinearity", "K2"),
        ("discerning",),
        10,
    ),
]


def applied(one, size):
    """The effect of one number at `size` times what is plausible."""
    effect = CATALOGUE[one.family]
    plausible = next(p.plausible for p in effect.parameters if p.name == one.parameter)
    value = np.asarray(size * plausible)
    if one.channel is not None:
        value = np.where(np.arange(3) == one.channel, value, 0.0)
    return AppliedEffect(effect, {**dict(one.shape), one.parameter: value}, installations=one.mounts)


@pytest.mark.parametrize(("one", "other", "blocks", "rho"), TIES, ids=[tie[0].family for tie in TIES])
def test_each_tie_of_the_papers_design_is_settled_by_the_block_that_is_made_for_it(one, other, blocks, rho):
    before = design()
    assert subspace_angles(before.seen((one,)), before.seen(other)).min() < np.arccos(0.999)
    found = [applied(one, rho / before.visible((one,)))]
    assert before.divergence(found, [other]) < 2.0
    for name in blocks:
        after = design(name)
        after.remounted((one.family, other[0].family), ("1", "2"))
        assert after.divergence(found, [other]) > 8.0


def test_one_reference_voltage_cannot_tell_a_square_term_from_its_own_error():
    """A reference whose value is known to 1e-4 alone: with both signs the error of the value drops out."""
    one, other, _, rho = TIES[-1]
    found = [applied(one, rho / design().visible((one,)))]
    assert design("inputs").divergence(found, [other]) < 1.0


def test_the_distance_is_that_of_generalised_least_squares():
    """Against the dense formula: the covariance of all that is random, the coefficients with no prior."""
    linear = make_linear(papers_settings(), MODEL, STAND_U)
    found = [applied(part("quadratic_nonlinearity", "K2", 0), 3.0)]
    forms = [(part("scale_asymmetry", "Kabs", 0),), all_channels("cubic_nonlinearity", "K3")]
    n = len(linear)
    covariance = NOISE.reading**2 * np.eye(n) + linear.random @ linear.random.T
    for number in range(54):
        along = np.where(linear.setting == number, linear.slope, 0.0)
        covariance += NOISE.setting_rad**2 * np.outer(along, along)
    inverse = np.linalg.inv(covariance)

    def left(columns, vector):
        free = np.column_stack([linear.fixed, *columns])
        best = np.linalg.pinv(free.T @ inverse @ free, rcond=1e-13) @ (free.T @ inverse @ vector)
        rest = vector - free @ best
        return rest @ inverse @ rest / 2.0

    vector = linear.effect_column(found[0])
    asymmetry = linear.effect_column(applied(forms[0][0], 1.0))
    cubic = [linear.effect_column(applied(one, 1.0)) for one in forms[1]]
    design_ = ReadingDesign(linear, NOISE)
    assert design_.divergence(found, [forms[0]]) == pytest.approx(left([asymmetry], vector), rel=1e-5)
    nearest = min(left([asymmetry], vector), left(cubic, vector))
    assert design_.divergence(found, forms) == pytest.approx(nearest, rel=1e-5)
    assert design_.visible((forms[0][0],)) == pytest.approx(math.sqrt(2 * left([], asymmetry)), rel=1e-5)


def test_an_effect_has_every_shape_and_channel_everywhere():
    forms = forms_everywhere("warm_up")
    assert len(forms) == len(next(p.grid for p in CATALOGUE["warm_up"].parameters if p.grid))
    assert [one.channel for one in forms[0]] == [0, 1, 2]


# --- proposals --------------------------------------------------------------------------------------


FIXED = OneThreshold(4.0, 0.003, 1.0, 0.05, 1.0, 3000)


def diagnosed(*effects, seed, passes=(1, 2, 3)):
    """A diagnosis of the paper's 54 settings with effects, from the tests' own simulation of the stand."""
    plain = paper_bench.simulate(np.random.default_rng(seed), 15e-6, stand_u=STAND_U)
    readings = replace(plain, direction=np.ones(len(plain), dtype=np.int64))
    readings = replace(readings, time_s=papers_settings().time_s)
    model = ForwardModel(MODEL.installations, effects)
    conditions = readings.conditions()
    still = np.zeros((2, 5))
    added = model.readings(BLOCK, conditions, still) - MODEL.readings(BLOCK, conditions, still)
    return diagnose(replace(readings, signal=readings.signal + added), MODEL, STAND_U, None, FIXED)


@pytest.fixture(scope="module")
def drifting():
    return diagnosed(applied(part("voltmeter_drift", "rate"), 10.0), seed=5)


@pytest.fixture(scope="module")
def agreeing():
    return diagnosed(seed=6)


def test_a_tie_is_settled_by_the_shortest_procedure_that_settles_it(drifting):
    assert drifting.verdict == "confounded"
    proposal = propose(drifting, BENCH)
    assert proposal.name == "inputs"
    (tie,) = proposal.settles
    assert {tie.effect, tie.other} == {"voltmeter_drift", "bias_drift"}
    assert tie.before < 2.0
    assert tie.after > 8.0
    assert proposal.minutes == pytest.approx(plan_of("inputs").expected_duration_s() / 60.0)
    assert "'inputs'" in proposal.why
    assert not proposal.left_out
    assert proposal.surer.hours == pytest.approx(proposal.minutes / 60.0)
    assert proposal.surer.answers > 0.9
    assert len(proposal.chances) == len(MENU)
    # what leaves the one an alias of the other answers nothing, whatever the odds
    assert next(one for one in proposal.chances if one.procedure == "verification").answers < 0.5


def test_a_tie_with_what_has_no_name_is_nothing_that_a_procedure_settles(drifting):
    (effect,) = drifting.effects
    others = (*effect.cannot_tell_from, "step")
    proposal = propose(replace(drifting, effects=(replace(effect, cannot_tell_from=others),)), BENCH)
    assert "step" not in {tie.other for tie in proposal.settles}
    alone = replace(drifting, effects=(replace(effect, cannot_tell_from=("step",)),))
    assert propose(alone, BENCH) is None


def test_where_nothing_on_the_menu_helps_nothing_is_proposed(drifting):
    assert propose(drifting, BENCH, [find_procedure("paper"), find_procedure("turn-12")]) is None
    outlier = Mistake("outlier", ("x",), (), 1, 1, "", 0.0, ())
    mistaken = replace(drifting, mistakes=replace(drifting.mistakes, mistakes=(outlier,)))
    for diagnosis in (mistaken, replace(drifting, of_copy="unknown")):
        assert propose(diagnosis, BENCH) is None


@pytest.mark.slow
def test_what_is_hidden_is_shown_by_the_shortest_procedure_that_shows_it(agreeing):
    assert agreeing.verdict == "agrees"
    menu = {name: find_procedure(name) for name in MENU}
    assert "mounting_roll" in propose(agreeing, BENCH, [menu["verification"]]).shows
    assert "backlash" in propose(agreeing, BENCH, [menu["calibration"]]).shows
    offset = propose(agreeing, BENCH, [menu["inputs"], menu["calibration"]])
    assert offset.name == "inputs"
    assert "voltmeter_offset" in offset.shows
    assert "wrong_gravity" not in propose(agreeing, BENCH).shows


@pytest.mark.slow
def test_what_the_bench_cannot_do_is_left_out_and_said(drifting, agreeing, tmp_path):
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    (tmp_path / "bench.yaml").write_text(
        "\n".join(line for line in text.splitlines() if not line.startswith(("  1T", "  2T")))
    )
    poor = load_bench(tmp_path / "bench.yaml")
    proposal = propose(drifting, poor)
    assert set(proposal.left_out) == {"remount-180", "remount-90", "discerning"}
    assert "has no installation 1T180" in proposal.left_out["remount-180"]
    assert "remount-90" in proposal.why
    including = tmp_path / "including.yaml"
    (tmp_path / "part.yaml").write_text(find_procedure("inputs").read_text(encoding="utf-8"))
    including.write_text("procedure: including\nsteps:\n  - include: part.yaml\n")
    assert propose(drifting, BENCH, [including]) is None
    counted = replace(agreeing.linear.readings, unit="counts")
    other_unit = replace(agreeing, linear=replace(agreeing.linear, readings=counted))
    assert set(propose(other_unit, BENCH).left_out) == {"inputs", "discerning"}


def test_a_proposal_is_a_procedure_and_never_written_over_another_file(drifting, bench, tmp_path):
    proposal = propose(drifting, BENCH)
    path = tmp_path / "proposed" / "next.yaml"
    assert proposal.procedure == find_procedure("inputs")
    assert proposal.write(path).procedure == path
    assert proposal.write(path).procedure == path
    path.write_text("mine")
    written = proposal.write(path)
    second = written.procedure
    assert second.name == "next-2.yaml"
    assert path.read_text() == "mine"
    lines = second.read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("# Proposed: the procedure 'inputs'")
    assert max(len(line) for line in lines[: lines.index("#")]) <= 110
    assert load_procedure(second).plan.steps == plan_of("inputs").steps
    status, _, _ = bench("check", second)
    assert status == 0
    as_json = ProposalPart.model_validate(written).to_dict()
    assert as_json["procedure"] == str(second)
    assert as_json["settles"][0]["after"] > 8.0


def test_the_chance_of_an_answer_is_that_of_normal_log_odds():
    """Against draws of ln of the odds: 70 to 30, and a D of 3 more; nothing more leaves them as they are."""
    odds, d, rng = {"a": 0.7, "b": 0.3}, 3.0, np.random.default_rng(4)
    now = np.log(0.7 / 0.3)
    true = np.where(rng.random(400_000) < 0.7, 1.0, -1.0)
    after = now + rng.normal(true * d, np.sqrt(2 * d))
    assert answers(odds, {"b": d}, "a") == pytest.approx(np.mean(np.abs(after) >= np.log(19)), abs=0.004)
    assert answers(odds, {"b": 0.0}, "a") == 0.0
    assert answers({"a": 0.99, "b": 0.01}, {"b": -math.inf}, "a") == 0.0
    assert answers(odds, {"b": 60.0}, "a") == pytest.approx(1.0, abs=1e-6)
    assert answers({**odds, "c": 0.3}, {"b": 60.0, "c": 0.0}, "a") < 0.5


# --- following --------------------------------------------------------------------------------------


def fake_diagnosis(monkeypatch, *proposed):
    """Stand in for the diagnosis of runs; return the list of what was diagnosed."""
    seen = []

    def diagnosed_(runs):
        seen.append([run.name for run in runs])
        return SimpleNamespace(procedure=Path(proposed[0]), minutes=60.0) if proposed else None

    monkeypatch.setattr(measure, "_diagnosed", diagnosed_)
    return seen


@pytest.mark.slow
def test_a_dry_run_is_followed_by_what_is_proposed_and_both_are_diagnosed(bench, monkeypatch, tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    seen = fake_diagnosis(monkeypatch, path)
    (tmp_path / "runs" / "a-2").mkdir(parents=True)
    status, _, _ = bench("run", path, "--dry-run", "--name", "a", "--seed", "4", "--follow")
    assert status == 0
    assert seen == [["a"], ["a", "a-3"]]
    first, second = (Run(tmp_path / "runs" / name) for name in ("a", "a-3"))
    assert second.manifest["seed"] == first.manifest["seed"] + 1
    assert not np.array_equal(first.readings().signal, second.readings().signal)


def test_nothing_follows_where_nothing_would_tell_more(bench, monkeypatch, tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    seen = fake_diagnosis(monkeypatch)
    status, out, _ = bench("run", path, "--dry-run", "--name", "a", "--follow")
    assert status == 0
    assert seen == [["a"]]
    assert "no procedure would show more" in out
    status, _, err = bench("run", path, "--dry-run", "--name", "b", "--follow", "--json", "-")
    assert status == 2
    assert "--follow makes two runs" in err


@pytest.mark.parametrize(("answer", "carried_out"), [("yes\n", True), ("no\n", False), ("", False)])
def test_on_real_instruments_the_person_is_asked(monkeypatch, tmp_path, answer, carried_out):
    fake_diagnosis(monkeypatch, "next.yaml")
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    told = io.StringIO()
    monkeypatch.setattr(measure.printing, "console", lambda: Console(file=told, width=200))
    done = []
    monkeypatch.setattr(measure, "_measured", lambda request, _: (None, done.append(request) or 1))
    manifest = {"bench": "mine.yaml", "bench_why": "as asked for"}
    run = SimpleNamespace(name="a", folder=tmp_path / "a", simulated=False, manifest=manifest)
    status = measure._follow(run, RunRequest("first.yaml", until="all=1e-4"))
    assert [(one.procedure, one.name, one.until) for one in done] == [
        ("next.yaml", "a-2", None)
    ] * carried_out
    assert status == (1 if carried_out else 0)
    assert carried_out or "measure it later with: bench run next.yaml --bench mine.yaml" in told.getvalue()


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        (0.97, "to decide: procedure 'discerning' (6.3 h) leaves one name with a probability of 97 %"),
        (
            0.02,
            "no procedure is likely to decide: procedure 'discerning' (6.3 h) leaves one name with a probability "
            "of only 2 %",
        ),
    ],
)
def test_a_measurement_that_hardly_ever_decides_is_not_recommended(answers, said):
    chance = Chance("discerning", 6.33, answers)
    proposal = Proposal("", find_procedure("discerning"), 380.0, chances=(chance,))
    assert surer_in_words(proposal) == said
