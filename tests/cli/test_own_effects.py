"""Effects of the user's own on the command line and in Python: known while a command lasts, kept with a run."""

import os
from pathlib import Path

import numpy as np
import pytest

import bench as face
from bench.config.bench_file.file import FileMistakes, load_bench
from bench.config.formulas import load_effects
from bench.model import CATALOGUE
from bench.readings.csv import write_csv
from bench.run.folder import Run
from bench.services.own_effects import knowing_effects_on_record, simulated_truth
from bench.validation.paper_bench import simulate
from tests.support.commands import printed, refused

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
MODEL = """\
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
    Path("model.yaml").write_text(MODEL)
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
