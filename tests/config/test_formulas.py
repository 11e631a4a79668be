"""Files with effects of the user's own, and the model and bench files that carry them."""

import re

import numpy as np
import pytest
import yaml

from bench.base.units import unit_of
from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench, load_recorded_bench
from bench.config.formulas import effects_in, effects_text, load_effects
from bench.config.model_file import load_model, write_model_file
from bench.config.shipped import find_bench
from bench.model import CATALOGUE, AppliedEffect, Block, Conditions, Stage
from bench.model.effects import ExpressionError, Seen
from bench.model.effects.formula import UNITS

ENTRY = """\
  - name: settling
    sentence: the bias settles as the head is turned to and fro
    stage: block output
    expression: A * exp(-travelled / turns) + B * lagged(temperature, lag)
    parameters:
      A: {plausible: 100 µg}
      B: {plausible: 20 ug/K, per_channel: no}
      turns: {grid: [0.5 rev, 1 rev, 720 deg], default: 1 rev}
      lag: {grid: [0 min, 10 min]}
"""
HEAD = "effects_file: 1\nformulas:\n"


def write(tmp_path, text, name="mine.yaml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def mistakes(tmp_path, text, loader=load_effects):
    with pytest.raises(FileMistakes) as raised:
        loader(write(tmp_path, text))
    return [(m.line, m.place, m.text) for m in raised.value.mistakes]


def test_a_formula_is_read_in_si_and_written_back_the_same(tmp_path):
    (effect,) = load_effects(write(tmp_path, HEAD + ENTRY))
    a, b, turns, lag = effect.parameters
    assert (effect.stage, effect.subsystem) == (Stage.BLOCK_OUTPUT, "block")
    assert (a.unit, a.per_channel, b.per_channel) == ("ug", True, False)
    assert a.plausible == pytest.approx(1e-4)
    assert turns.grid == pytest.approx((np.pi, 2 * np.pi, 4 * np.pi))
    assert turns.default == pytest.approx(2 * np.pi)
    assert (lag.grid, lag.default) == ((0.0, 600.0), 600.0)
    assert "travelled" in effect.shown_by
    again = write(tmp_path, yaml.safe_dump(effects_text([effect]), sort_keys=False), "again.yaml")
    assert load_effects(again) == (effect,)


@pytest.mark.parametrize(
    ("old", "new", "line", "told"),
    [
        ("100 µg", "100 µV", 6, "the expression gives V|combines V with a plain number"),
        ("100 µg", "100", None, None),
        ("100 µg", "-100 ug", 7, "above 0"),
        ("100 µg", "100 ugg", 7, "unknown unit 'ugg'"),
        ("plausible: 100 µg", "per_channel: yes", 7, "give its plausible size"),
        ("plausible: 100 µg", "plausible: 1 ug, grid: [1 ug]", 7, "not both"),
        ("1 rev, 720 deg], default: 1 rev", "1 rev]", None, None),
        ("1 rev, 720 deg]", "1 min]", 7, "units of one kind"),
        ("default: 1 rev", "default: 3 rev", 7, "not in the grid"),
        ("lag: {grid: [0 min, 10 "
        "min]}", "lag: {grid: [1 V]}", 6, "the second argument of 'lagged' is not a time"),
        ("travelled / turns", "time * turns", 6, "exp needs a plain number or an angle, not s"),
        ("+ B", "+ time * B", 6, "combines a plain number or an angle with s; give both the same unit"),
        ("travelled / turns", "turns * (time > 40 min)", None, None),
        ("travelled / turns", "turns * (time > 2400)", 6, "write the number with its unit, such as '2400 s'"),
        ("travelled / turns", "turns * (time > 3 V)", 6, "'>' combines s with V; give both the same unit"),
        ("settling", "hysteresis", 3, "the bench already has an effect 'hysteresis'"),
        ("settling", "Settling!", 3, "small letters"),
        ("stage: block output", "stage: block", 5, "did you mean 'block output'"),
        ("      A:", "      a:", 7, "'a' is reserved in formulas"),
        ("    sentence: the", "    sentences: the", 4, "sentence"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_its_line(tmp_path, old, new, line, told):
    text = (HEAD + ENTRY).replace(old, new)
    assert text != HEAD + ENTRY
    if told is None:
        assert load_effects(write(tmp_path, text))
        return
    found = mistakes(tmp_path, text)
    assert any(
        at == line and any(word in said for word in told.replace("\\", "").split("|"))
        for at, _, said in found
    ), found


@pytest.mark.parametrize("unit", UNITS)
def test_units_in_a_formula_are_those_of_files(unit):
    si, of = UNITS[unit]
    factor, dimension = unit_of(unit)
    assert si == pytest.approx(factor, rel=1e-15)
    assert dimension == unit_of(of)[1]


def test_all_mistakes_at_once_and_two_of_a_name(tmp_path):
    found = mistakes(tmp_path, HEAD + ENTRY + ENTRY.replace("A *", "A * A *"))
    assert [place for _, place, _ in found] == ["formulas[2].expression"]
    found = mistakes(tmp_path, HEAD + ENTRY + ENTRY)
    assert found[0][2] == "rename one of two formulas named settling"
    other = write(tmp_path, HEAD + ENTRY.replace("100 µg", "50 ug"), "other.yaml")
    with pytest.raises(FileMistakes, match="a different formula named settling"):
        effects_in([write(tmp_path, HEAD + ENTRY), other])


def test_a_formula_that_gives_no_number_is_told_with_file_and_line(tmp_path):
    path = write(
        tmp_path, HEAD + ENTRY.replace("exp(-travelled / turns)", "exp(-turns / travelled) / travelled")
    )
    (effect,) = load_effects(path)
    conditions = Conditions.of(["1", "1"], [0.0, 1.0], time_s=[0.0, 60.0])
    block = Block(np.diag([-2.0, -2.0, -2.0]), np.zeros(3))
    applied = AppliedEffect(effect, {"A": np.full(3, 1e-4)})
    with pytest.raises(ExpressionError, match=rf"^{re.escape(str(path))}, line 6: .*division by zero"):
        applied.addition(Seen(np.ones((2, 3)), conditions, block))


def test_a_model_file_carries_the_formula_it_rests_on(tmp_path):
    (effect,) = load_effects(write(tmp_path, HEAD + ENTRY))
    values = {"A": np.array([1e-5, 0.0, 2e-5]), "turns": np.asarray(2 * np.pi)}
    path = tmp_path / "model.yaml"
    write_model_file(path, "found", [AppliedEffect(effect, values, ("x", "z"), {"A": np.full(3, 1e-6)})])
    (read,) = load_model(path).applied_effects()
    assert read.effect == effect
    np.testing.assert_allclose(read.values["A"], values["A"])
    assert "settling" not in CATALOGUE
    bare = path.read_text(encoding="utf-8")
    bare = bare[: bare.index("formulas:")] + bare[bare.index("effects:") :]
    assert "unknown effect 'settling'" in mistakes(tmp_path, bare, load_model)[0][2]
    with CATALOGUE.also([effect]):
        assert load_model(path).applied_effects()[0].effect == effect
        assert load_model(write(tmp_path, bare, "bare.yaml")).applied_effects()[0].effect == effect
    with CATALOGUE.also(load_effects(write(tmp_path, (HEAD + ENTRY).replace("100 µg", "9 ug")))):
        assert "differ" in mistakes(tmp_path, path.read_text(encoding="utf-8"), load_model)[0][2]


def test_a_parameter_may_be_called_as_a_key_of_model_files(tmp_path):
    (effect,) = load_effects(write(tmp_path, HEAD + ENTRY.replace("turns", "changes")))
    values = {"A": np.full(3, 1e-5), "changes": np.asarray(2 * np.pi)}
    write_model_file(tmp_path / "model.yaml", "found", [AppliedEffect(effect, values)])
    assert load_model(tmp_path / "model.yaml").applied_effects()[0].effect == effect


def test_a_bench_file_has_formulas_of_its_own(tmp_path):
    shipped = find_bench("paper-stand").read_text(encoding="utf-8")
    effects = "effects:\n  - {name: settling, channels: [x], parameters: {A: 30 ug}}\n"
    bench = load_bench(write(tmp_path, f"{shipped}\nformulas:\n{ENTRY}{effects}"))
    assert [effect.name for effect in bench.own_effects()] == ["settling"]
    assert bench.applied_effects()[0].values["A"] == pytest.approx([3e-5, 0, 0])
    assert load_recorded_bench(tmp_path / "mine.yaml").own_effects() == bench.own_effects()
    found = mistakes(tmp_path, f"{shipped}\nformulas:\n{ENTRY}{effects.replace('A:', 'C:')}", load_bench)
    assert "parameter of settling" in found[0][2]
