"""Terms without a name get one, as an effect of the user's own, and nothing is overwritten."""

from pathlib import Path

import pytest

from bench.config.formulas import load_effects
from bench.config.model_file import load_model

MODEL = """\
model_file: 1
name: paper + unnamed_1[y]
dark_uncertainty: 12 uV
formulas:
  - name: unnamed_1
    sentence: something
    stage: block output
    expression: A * exp(-time / tau)
    parameters: {A: {plausible: 30 ug}, tau: {grid: [10 min]}}
  - name: unnamed_2
    sentence: something
    stage: block output
    expression: A * exp(-time / tau)
    parameters: {A: {plausible: 30 ug}, tau: {grid: [40 min]}}
  - name: unnamed_3
    sentence: something
    stage: head angle
    expression: A * turned / (2 * pi)
    parameters: {A: {plausible: 10 arcsec}}
effects:
  - {name: unnamed_1, channels: [x], parameters: {A: {x: {value: 90 ug, u: 3 ug}}, tau: 10 min}}
  - {name: quadratic_nonlinearity, channels: [x], parameters: {K2: 40 ug/g^2}}
  - name: unnamed_2
    channels: [x, z]
    parameters: {A: {x: {value: -20 ug, u: 4 ug}, z: {value: 9 ug, u: 4 ug}}, tau: 40 min}
  - {name: unnamed_3, parameters: {A: {value: 25 arcsec, u: 1 arcsec}}}
"""
NAME = ("--name", "slow_settling", "--sentence", "the bias settles twice")


@pytest.fixture
def accept(bench):
    Path("m.yaml").write_text(MODEL)
    return lambda *args: bench("accept", "m.yaml", *args)


def test_two_terms_become_one_effect_that_a_model_has(accept):
    status, out, err = accept(*NAME, "--term", "unnamed_1", "--term", "unnamed_2")
    assert status == 0, err
    assert "--effects slow_settling.yaml" in out
    (effect,) = load_effects(Path("slow_settling.yaml"))
    assert effect.sentence == "the bias settles twice"
    assert effect.expression == "A1 * exp(-time / tau) + A2 * exp(-time / tau2)"
    first, tau, second, tau2 = effect.parameters
    assert (first.name, second.name) == ("A1", "A2")
    assert first.plausible == pytest.approx(90e-6)
    assert second.plausible == pytest.approx(30e-6)
    assert tau.grid == (300.0, 600.0, 1200.0)
    assert tau2.default == 2400.0
    model = load_model(Path("m-slow_settling.yaml"))
    settling, square, turned = model.applied_effects()
    assert [a.effect.name for a in (settling, square, turned)] == [
        "slow_settling", "quadratic_nonlinearity", "unnamed_3",
    ]  # fmt: skip
    assert settling.effect == effect
    assert settling.channels == ("x", "z")
    assert settling.values["A1"] == pytest.approx([90e-6, 0, 0])
    assert settling.u["A2"] == pytest.approx([4e-6, 0, 4e-6])
    assert model.dark_uncertainty == "12 uV"


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (NAME, "act at different places"),
        (
            (*NAME, "--term", "unnamed_7"),
            "there is no term unnamed_7; there are unnamed_1, unnamed_2, unnamed_3",
        ),
        (("--name", "Slow!", "--sentence", "x", "--term", "unnamed_1"), "small letters"),
        (("--name", "warm_up", "--sentence", "x", "--term", "unnamed_1"), "has an effect 'warm_up' already"),
        ((*NAME, "--term", "unnamed_3", "--out", "no/where.yaml"), "cannot be written"),
    ],
)
def test_what_cannot_be_is_told_and_nothing_is_written(accept, args, told):
    before = sorted(Path().iterdir())
    status, _, err = accept(*args)
    assert status == 2
    assert told in err
    assert sorted(Path().iterdir()) == before


def test_nothing_is_overwritten_and_a_model_without_terms_is_told(accept, bench):
    one = (*NAME, "--term", "unnamed_3")
    assert accept(*one)[0] == 0
    status, _, err = accept(*one)
    assert status == 2
    assert "slow_settling.yaml: a file of that name is there" in err
    Path("plain.yaml").write_text("model_file: 1\nname: plain\n")
    status, _, err = bench("accept", "plain.yaml", *NAME)
    assert status == 2
    assert "no term without a name" in err


def test_both_phases_of_a_wave_are_as_plausible_as_the_larger(accept):
    wave = MODEL.replace("A * exp(-time / tau)", "A * cos(angle) + tau * sin(angle)", 1)
    wave = wave.replace("tau: {grid: [10 min]}", "tau: {plausible: 30 ug}").replace(
        "tau: 10 min", "tau: 5 ug"
    )
    Path("m.yaml").write_text(wave)
    assert accept(*NAME, "--term", "unnamed_1")[0] == 0
    (effect,) = load_effects(Path("slow_settling.yaml"))
    assert [p.plausible for p in effect.parameters] == pytest.approx([90e-6, 90e-6])
