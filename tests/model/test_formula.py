"""Effects stated as a formula: read through a whitelist, worked out as by hand, known only for a while."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evidence import formulas
from bench.model import CATALOGUE, AppliedEffect, Conditions, ForwardModel, Parameter, Stage, Subsystem
from bench.model.effects import ExpressionError, FormulaEffect, Seen
from bench.model.effects.block import CrossCoupling, WarmUp
from bench.model.effects.formula import MOST_CHARACTERS, parse
from tests.support.effect_bench import ALPHA4, BLOCK, CONDITIONS, INSTALLATIONS, SECOND, STAND, TIME_S

SIZE = Parameter("A", "1", 1.0, 1e-5, per_channel=False)
EACH = replace(SIZE, per_channel=True)
TAU = Parameter("tau", "min", 60.0, 1200.0, per_channel=False, grid=(600.0, 1200.0), default=1200.0)


def formula(expression, stage=Stage.BLOCK_OUTPUT, parameters=(SIZE,), adds_to=""):
    return FormulaEffect("mine", stage, Subsystem.BLOCK, parameters, "it does", "more", expression, adds_to)


def added(effect, values, conditions=CONDITIONS):
    n = len(conditions)
    width = {Stage.STAND: (n, 5), Stage.HEAD_ANGLE: (n,)}.get(effect.stage, (n, 3))
    signal = np.random.default_rng(3).uniform(-1, 1, width)
    return signal, effect.addition(
        {k: np.asarray(v) for k, v in values.items()}, Seen(signal, conditions, BLOCK)
    )


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "A.real", "A[0]", "lambda: A", "[A for A in a]", "A if a else A",
        "A and a", "not A", "f'{A}'", "'A'", "True", "1j", "A @ a", "A // a", "A % a", "A < a < 1", "A == a",
        "sin(A, a)", "sin(*a)", "sin(x=a)", "open(a)", "A(a)", "(A := a)", "A; a", "", "A +", "*A", "await A",
        "max(a)", "A\nA", "(" * 500 + "A" + ")" * 500, "A" * (MOST_CHARACTERS + 1), "-" * 900 + "A", "A ** ...",
        "~A", "A << 2", "None", "b'A'", "print", "yield A",
    ],
)  # fmt: skip
def test_what_is_no_formula_is_refused_and_never_run(text):
    with pytest.raises(ExpressionError):
        formula(text)


def test_a_tower_of_powers_ends_at_once_and_is_told():
    effect = formula("A * 9**9**9**9")
    with pytest.raises(ExpressionError, match="no finite number for reading 1"):
        added(effect, {"A": 1.0})
    with pytest.raises(ExpressionError, match="too large"):
        formula(f"A * {10**400}")
    assert parse("A*1e400")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("A * b", "'b' is unknown"),
        ("A * U", "'U' is unknown"),
        ("A + a", "a term has no size"),
        ("A * A", "not linear"),
        ("a / A", "not linear"),
        ("A * (A > 0)", "not linear"),
        ("exp(A)", "exp contains a size"),
        ("A ** 2", "not linear"),
        ("lagged(A, 60)", "lagged contains a size"),
        ("A * lagged(a, time)", "the lag of 'lagged'"),
        ("a", "is not in the expression; use or remove it"),
    ],
)
def test_what_no_fit_could_use_is_told(text, told):
    with pytest.raises(ExpressionError, match=told):
        formula(text)
    assert formula("A * 2 - a * A / (1 + a**2)")


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("A * (U > 0.3 V)", "A * (U > 0.3)"),
        ("A * (U > 500mV) * (U < .8 V)", "A * (U > 0.5) * (U < 0.8)"),
        ("A * exp(-time / 40 min)", "A * exp(-time / 2400)"),
        ("A * sin(angle - 90 deg) * 2e-1", "A * sin(angle - pi / 2) * 0.2"),
        ("A * sin(angle - 90°)", "A * sin(angle - pi / 2)"),
        ("A * lagged(temperature, 5 min)", "A * lagged(temperature, 300)"),
        ("A * (U > -1.5e3 mV)", "A * (U > -1.5)"),
    ],
)
def test_a_number_may_have_a_unit(text, same):
    got, expected = (added(formula(one, Stage.VOLTMETER_READING), {"A": 1.0})[1] for one in (text, same))
    assert np.any(expected)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("text", ["A * (U > 1.3 W)", "A * 2 sin(angle)", "A * (U > 1.3 V2)", "A * 1.5.real"])
def test_another_word_after_a_number_is_refused(text):
    with pytest.raises(ExpressionError):
        formula(text, Stage.VOLTMETER_READING)


ON_S = TIME_S + 900.0


@pytest.mark.parametrize(
    ("variable", "on_s", "expected"),
    [
        ("since_start", None, TIME_S),
        ("since_mounting", None, TIME_S - np.where(SECOND, TIME_S[18], TIME_S[0])),
        ("since_power_on", None, TIME_S),
        ("since_power_on", ON_S, ON_S),
        ("since_power_on", np.where(SECOND, ON_S, np.nan), np.where(SECOND, ON_S, TIME_S)),
    ],
)
def test_times_count_from_the_start_the_mounting_or_the_power(variable, on_s, expected):
    effect = formula(f"A * {variable} / 1 h", Stage.HEAD_ANGLE)
    assert effect.needs_history == (variable == "since_mounting")
    got = added(effect, {"A": 1.0}, replace(CONDITIONS, on_s=on_s))[1]
    np.testing.assert_allclose(got, expected / 3600, rtol=1e-12, atol=1e-15)


def test_a_mounting_of_a_later_run_begins_anew():
    began = np.array([0.0, 0.0, 5000.0, 5000.0])
    conditions = Conditions.of(
        ["1", "1", "1", "1"], [0.0, 1.0, 0.0, 1.0], time_s=[100.0, 300.0, 5050.0, 5250.0], began_s=began
    )
    np.testing.assert_array_equal(conditions.since_mounting_s, [0.0, 200.0, 0.0, 200.0])


def test_a_stand_effect_says_which_angle():
    with pytest.raises(ExpressionError, match="adds_to"):
        formula("A", Stage.STAND)
    with pytest.raises(ExpressionError, match="adds_to"):
        formula("A", adds_to="axis_tilt")
    effect = formula("A * cos(3 * angle)", Stage.STAND, adds_to="mounting_roll")
    _, got = added(effect, {"A": 2e-5})
    np.testing.assert_allclose(got[:, 4], 2e-5 * np.cos(3 * CONDITIONS.angle_rad))
    assert not got[:, :4].any()


def test_a_formula_gives_what_the_class_gives():
    products = formula("A * a * aj + B * aj * ak", parameters=(EACH, replace(EACH, name="B")))
    values = {"A": [1e-5, 2e-5, 3e-5], "B": [-1e-5, 0, 4e-5]}
    signal, got = added(products, values)
    as_class = {"Kip": np.array(values["A"]), "Kio": np.zeros(3), "Kpo": np.array(values["B"])}
    np.testing.assert_allclose(got, CrossCoupling().addition(as_class, Seen(signal, CONDITIONS, BLOCK)))
    _, got = added(formula("A * exp(-time / tau)", parameters=(EACH, TAU)), {"A": values["A"], "tau": 900.0})
    as_class = {"A": np.array(values["A"]), "tau": np.array(900.0)}
    np.testing.assert_allclose(got, WarmUp().addition(as_class, Seen(signal, CONDITIONS, BLOCK)))


def test_the_turns_of_the_head_by_hand():
    degrees = [350, 20, np.nan, 210, 190, 10, 100]
    conditions = Conditions.of(["1", "1", "S", "1", "1", "2", "2"], np.radians(degrees))
    for name, expected in {
        "turned": [0, 30, 30, -140, -160, 0, 90],
        "wound": [0, 30, 30, -140, -160, 20, 110],
        "travelled": [0, 30, 30, 200, 220, 0, 90],
    }.items():
        effect = formula(f"A * {name}", Stage.HEAD_ANGLE)
        assert effect.needs_history
        _, got = added(effect, {"A": 1.0}, conditions)
        np.testing.assert_allclose(np.degrees(got), expected, atol=1e-9, err_msg=name)
    _, got = added(formula("A * visit", Stage.HEAD_ANGLE), {"A": 1.0}, conditions)
    assert got.tolist() == [1, 1, 1, 1, 1, 2, 2]


def test_a_reading_without_an_angle_has_none_of_it_and_other_infinities_are_told():
    conditions = Conditions.of(["1", "F"], [0.0, np.nan], time_s=[0.0, 60.0])
    _, got = added(formula("A * (2 + sin(angle))"), {"A": 1.0}, conditions)
    assert got[0].all()
    assert not got[1].any()
    with pytest.raises(ExpressionError, match="no finite number for reading 1"):
        added(formula("A / time"), {"A": 1.0}, conditions)


def test_it_acts_on_rows_and_mountings_like_any_other():
    effect = formula("A * (U > 0) * lagged(Uy, tau)", Stage.VOLTMETER_READING, (SIZE, TAU))
    applied = AppliedEffect(effect, {"A": np.asarray(1e-3)}, installations=("2",))
    args = BLOCK, CONDITIONS, STAND, ALPHA4
    change = ForwardModel(INSTALLATIONS, (applied,)).readings(*args) - ForwardModel(INSTALLATIONS).readings(
        *args
    )
    second = np.array([str(CONDITIONS.mounts[m]) == "2" for m in CONDITIONS.mount])
    assert not change[~second].any()
    assert change[second].any()


def test_it_goes_to_another_process_and_back():
    effect = formula("A * a**2", parameters=(EACH,))
    assert pickle.loads(pickle.dumps(effect)) == effect  # noqa: S301 - our own
    assert hash(pickle.loads(pickle.dumps(effect))) == hash(effect)  # noqa: S301 - our own


def test_the_catalogue_knows_it_for_a_while():
    effect = formula("A * a**2")
    before = list(CATALOGUE)
    with CATALOGUE.also([effect, effect]):
        assert [*before, "mine"] == list(CATALOGUE)
        assert CATALOGUE["mine"] is effect
        assert len(formulas()) == 1
        with CATALOGUE.also([formula("A * a**2")]):
            assert len(CATALOGUE) == len(before) + 1
        with (
            pytest.raises(ValueError, match="two formulas of the name 'mine' differ"),
            CATALOGUE.also([formula("A * a")]),
        ):
            pass
    assert list(CATALOGUE) == before
    assert formulas() == []
    taken = replace(effect, name="hysteresis")
    with pytest.raises(ValueError, match="already has an effect 'hysteresis'"), CATALOGUE.also([taken]):
        pass
