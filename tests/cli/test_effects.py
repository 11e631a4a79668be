"""Effects by way of the command line: a dry run has them, also when it was interrupted; a fit finds them."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.config.shipped import find_bench
from bench.model.effects import CATALOGUE
from bench.run.folder import Run
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
    """Each within four standard uncertainties of the truth; the shape stays as the file has it."""
    text = "model_file: 1\nname: m\neffects:\n"
    text += (
        "  - name: cubic_nonlinearity\n    parameters: {K3: {x: 600 ug/g^3, y: -500 ug/g^3, z: 400 ug/g^3}}\n"
    )
    text += "  - name: axis_wobble\n    parameters: {cosine: 60 arcsec, sine: -40 arcsec, harmonic: 2}\n"
    Path("truth.yaml").write_text(text, encoding="utf-8")
    named = "model_file: 1\nname: named\neffects:\n  - name: cubic_nonlinearity\n    parameters: {}\n"
    named += "  - name: axis_wobble\n    parameters: {harmonic: 2}\n"
    Path("named.yaml").write_text(named, encoding="utf-8")
    bench("run", "paper", "--dry-run", "--seed", "3", "--name", "r", "--model", "truth.yaml")
    status, out, err = bench("calibrate", "r", "--model", "named.yaml", "--json", "-")
    assert status == 0, err
    found = json.loads(out)["effects"]
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
    evaluations = [(name, "r", "--json", "-") for name in ("calibrate", "verify", "diagnose")]
    before = [bench(*arguments)[:2] for arguments in evaluations]

    monkeypatch.delitem(CATALOGUE, "backlash")
    after = [bench(*arguments) for arguments in evaluations]
    assert [told[:2] for told in after[:2]] == before[:2]
    assert after[2][0] == before[2][0], after[2][2]
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
        status, _, err = bench(*arguments)
        assert (status, "unknown effect 'backlash'" in err) == (2, True), (arguments, err)
