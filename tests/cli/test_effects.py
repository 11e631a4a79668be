"""Effects on the command line, the user's own too: a dry run has them, a fit finds them."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bench as face
from bench.config.bench_file.file import FileMistakes, load_bench
from bench.config.formulas import load_effects
from bench.config.model_file import load_model
from bench.config.shipped import find_bench
from bench.model import CATALOGUE
from bench.readings.csv import write_csv
from bench.run.folder import Run
from bench.services.own_effects import knowing_effects_on_record, simulated_truth
from bench.services.source import Request, load_sources
from bench.validation.paper_bench import simulate
from tests.support.commands import printed, refused
from tests.support.diagnosis_bench import paper_run
from tests.support.runner_bench import interrupt_at

LOOKING_BACK = """\
model_file: 1
name: looking back
effects:
  - name: hysteresis
    parameters: {size: 2 mg, width_g: 0.25 g}
  - name: channel_crosstalk
    parameters: {fraction: 200 ppm}
  - name: turn_on_shift
    installations: ["2"]
    parameters: {step: 3 mg}
"""


@pytest.mark.slow
def test_a_resumed_dry_run_remembers_what_was_read_before(bench, monkeypatch):
    """Effects look back past the interruption; recalled settings lack alpha4, 200 ppm of which is 1e-8 V."""
    Path("model.yaml").write_text(LOOKING_BACK, encoding="utf-8")
    dry_run = ("run", "quick", "--dry-run", "--seed", "5")
    assert bench(*dry_run, "--name", "whole", "--model", "model.yaml")[0] in {0, 1}
    with monkeypatch.context() as patch:
        patch.setattr("bench.run.runner.Recorder.emit", interrupt_at(60))
        assert bench(*dry_run, "--name", "cut", "--model", "model.yaml")[0] == 2
    assert bench("resume", "cut")[0] in {0, 1}
    whole, resumed = (Run(Path("runs") / name).readings() for name in ("whole", "cut"))
    np.testing.assert_allclose(resumed.signal, whole.signal, rtol=0, atol=3e-8)


@pytest.mark.slow
def test_the_model_that_a_dry_run_obeyed_is_found_by_a_fit(bench):
    """Each within four standard uncertainties of the truth; the shape stays as the file has it.

    Without the model the fit is not accepted, by the run as by `calibrate`.
    """
    text = "model_file: 1\nname: m\neffects:\n"
    text += (
        "  - name: cubic_nonlinearity\n    parameters: {K3: {x: 600 ug/g^3, y: -500 ug/g^3, z: 400 ug/g^3}}\n"
    )
    text += "  - name: axis_wobble\n    parameters: {cosine: 60 arcsec, sine: -40 arcsec, harmonic: 2}\n"
    Path("truth.yaml").write_text(text, encoding="utf-8")
    named = "model_file: 1\nname: named\neffects:\n  - name: cubic_nonlinearity\n    parameters: {}\n"
    named += "  - name: axis_wobble\n    parameters: {harmonic: 2}\n"
    Path("named.yaml").write_text(named, encoding="utf-8")
    run = ("run", "paper", "--dry-run", "--seed", "3", "--name", "r", "--model", "truth.yaml")
    assert (bench(*run)[0], bench("calibrate", "r")[0]) == (1, 1)
    result = json.loads(printed(bench("calibrate", "r", "--model", "named.yaml", "--json", "-")))
    assert (result["model"], result["residual"]["p"] > 0.01) == ("named", True)
    found = result["effects"]
    assert found["cubic_nonlinearity.K3[x]"]["unit"] == "ug/g^3"
    true = {
        "cubic_nonlinearity.K3[x]": 600,
        "cubic_nonlinearity.K3[y]": -500,
        "cubic_nonlinearity.K3[z]": 400,
        "axis_wobble.cosine": 60,
        "axis_wobble.sine": -40,
    }
    assert set(found) == set(true)
    for name, value in true.items():
        assert found[name]["value"] == pytest.approx(value, abs=4 * found[name]["u"]), name
        assert abs(value) > 8 * found[name]["u"], name


@pytest.mark.slow
def test_a_run_is_evaluated_when_an_effect_of_its_simulation_is_known_no_more(bench, monkeypatch):
    """What only the simulation needed may go; whatever simulates with it, or is told to fit it, refuses it."""
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    text += "effects:\n  - {name: backlash, parameters: {play: 8 arcsec}}\n"
    Path("b.yaml").write_text(text, encoding="utf-8")
    simulated = ("run", "quick", "--bench", "b.yaml", "--dry-run")
    assert bench(*simulated, "--name", "r")[0] in {0, 1}
    evaluations = [(name, "r", "--json", "-") for name in ("calibrate", "verify")]
    before = [bench(*arguments)[:2] for arguments in evaluations]

    monkeypatch.delitem(CATALOGUE._known, "backlash")
    after = [bench(*arguments) for arguments in evaluations]
    assert [told[:2] for told in after] == before
    assert bench("diagnose", "r", "--no-report")[0] == 0
    assert bench("report", "r")[0] == before[1][0]
    Path("m.yaml").write_text(
        "model_file: 1\nname: m\neffects:\n  - {name: backlash, parameters: {}}\n", encoding="utf-8"
    )
    for arguments in (
        (*simulated, "--name", "again"),
        ("check", "quick", "--bench", "b.yaml"),
        ("simulate", "--bench", "b.yaml"),
        ("calibrate", "r", "--bench", "b.yaml"),
        ("calibrate", "r", "--model", "m.yaml"),
    ):
        refused(bench(*arguments), "unknown effect 'backlash'")


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
    printed(accept(*NAME, "--term", "unnamed_1", "--term", "unnamed_2"), "--effects slow_settling.yaml")
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
            "there is no term unnamed_7; choose from unnamed_1, unnamed_2, unnamed_3",
        ),
        (("--name", "Slow!", "--sentence", "x", "--term", "unnamed_1"), "small letters"),
        (("--name", "warm_up", "--sentence", "x", "--term", "unnamed_1"), "already has an effect 'warm_up'"),
        ((*NAME, "--term", "unnamed_3", "--out", "no/where.yaml"), "cannot be written"),
    ],
)
def test_what_cannot_be_is_told_and_nothing_is_written(accept, args, told):
    before = sorted(Path().iterdir())
    refused(accept(*args), told)
    assert sorted(Path().iterdir()) == before


def test_nothing_is_overwritten_and_a_model_without_terms_is_told(accept, bench):
    one = (*NAME, "--term", "unnamed_3")
    assert accept(*one)[0] == 0
    refused(accept(*one), "slow_settling.yaml: this file exists")
    Path("plain.yaml").write_text("model_file: 1\nname: plain\n")
    refused(bench("accept", "plain.yaml", *NAME), "plain.yaml: has no unnamed term")


def test_both_phases_of_a_wave_are_as_plausible_as_the_larger(accept):
    wave = MODEL.replace("A * exp(-time / tau)", "A * cos(angle) + tau * sin(angle)", 1)
    wave = wave.replace("tau: {grid: [10 min]}", "tau: {plausible: 30 ug}").replace(
        "tau: 10 min", "tau: 5 ug"
    )
    Path("m.yaml").write_text(wave)
    assert accept(*NAME, "--term", "unnamed_1")[0] == 0
    (effect,) = load_effects(Path("slow_settling.yaml"))
    assert [p.plausible for p in effect.parameters] == pytest.approx([90e-6, 90e-6])


SETTLING = """\
effects_file: 1
formulas:
  - name: settling
    sentence: the bias settles
    stage: block output
    expression: A * exp(-since_power_on / 40 min)
    parameters:
      A: {plausible: 100 ug}
"""


def test_a_formula_that_counts_from_power_on_is_told_where_nobody_says_when_that_was(empty_folder):
    path = Path("settling.yaml")
    path.write_text(SETTLING, encoding="utf-8")
    table = paper_run(None)

    def told():
        write_csv(table, Path("r.csv"))
        (source,) = load_sources(Request(["r.csv"], Path("runs")))
        return [note for note in source.readings.notes if "switched on" in note]

    assert told() == []
    with CATALOGUE.also(load_effects(path)):
        (note,) = told()
        assert note.endswith("since_power_on of settling counts from the start of the run")
        table = replace(table, extra={"since_power_on_s": np.full(len(table), "60")})
        assert told() == []


EFFECTS = """\
effects_file: 1
formulas:
  - name: fourth_power
    sentence: the output has a part with the fourth power
    stage: block output
    expression: K4 * a**4
    parameters:
      K4: {plausible: 20 ug/g^4}
"""
WITH_OWN = """\
model_file: 1
name: with it
effects:
  - name: fourth_power
    channels: [x]
    parameters: {K4: 50 ug/g^4}
"""


@pytest.fixture
def files(bench):
    """The working folder with a file of effects, a model that names it, readings."""
    Path("mine.yaml").write_text(EFFECTS)
    Path("model.yaml").write_text(WITH_OWN)
    write_csv(simulate(np.random.default_rng(5), 1e-5), Path("readings.csv"))
    return bench


@pytest.mark.slow
def test_a_model_that_names_it_is_read_with_the_option_alone(files, monkeypatch):
    refused(files("calibrate", "readings.csv", "--model", "model.yaml"), "unknown effect 'fourth_power'")
    asked = ("calibrate", "readings.csv", "--model", "model.yaml")
    printed(files(*asked, "--effects", "mine.yaml"), "fourth_power.K4[x]")
    assert "BENCH_EFFECTS" not in os.environ
    assert "fourth_power" not in CATALOGUE
    monkeypatch.setenv("BENCH_EFFECTS", "mine.yaml")
    assert files(*asked)[0] == 0
    assert os.environ["BENCH_EFFECTS"] == "mine.yaml"


def test_a_file_with_mistakes_is_told_with_lines(files):
    Path("mine.yaml").write_text(EFFECTS.replace("a**4", "b**4"))
    refused(
        files("calibrate", "readings.csv", "--effects", "mine.yaml"),
        "mine.yaml:6: formulas[1].expression: 'b' is unknown; at the stage",
    )
    refused(files("calibrate", "readings.csv", "--effects", "nothing.yaml"), "there is no such file")


@pytest.mark.slow
def test_the_record_of_a_run_keeps_it(files, monkeypatch):
    monkeypatch.setattr("bench.results.page.render_report", lambda *_, **__: "")
    command = ("run", "quick", "--dry-run", "--name", "own", "--model", "model.yaml")
    assert files(*command, "--effects", "mine.yaml")[0] in (0, 1)
    run = Run(Path("runs/own"))
    with knowing_effects_on_record(run):
        truth = simulated_truth(load_bench(run.folder / "bench.yaml"), run.folder / "model.yaml")
    (applied,) = truth.effects
    assert applied.effect.name == "fourth_power"
    assert applied.values["K4"] == pytest.approx([5e-5, 0.0, 0.0])
    Path("mine.yaml").write_text(EFFECTS.replace("20 ug", "30 ug"))
    with (
        CATALOGUE.also(load_effects(Path("mine.yaml"))),
        pytest.raises(FileMistakes, match="two formulas of the name 'fourth_power' differ"),
    ):
        knowing_effects_on_record(run)


def test_python_takes_it_for_one_call(files):
    with_it = face.calibrate("readings.csv", model="model.yaml", effects="mine.yaml")
    assert "fourth_power.K4[x]" in with_it.calibration.effects
    assert "fourth_power" not in CATALOGUE
    assert [effect.name for effect in with_it.source.effects] == ["fourth_power"]
