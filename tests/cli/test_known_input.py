"""`bench calibrate`, `report` and `stability` on a record at a known input, and the commands that refuse it."""

import json
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.panel.results import results_of
from bench.run.folder import Run
from tests.support.commands import refused
from tests.support.schemas import keeps_to


@pytest.fixture
def record(bench):
    """A record of two channels at 0 V and 10 V, irregular in time and with a gap."""
    rng = np.random.default_rng(5)
    count = 400
    time_s = np.cumsum(rng.choice([21.0, 22.0], count))
    time_s[250:] += 600.0
    reference = 10.0 * (np.arange(count) // 8 % 2)
    signal = np.outer(reference, [1.0 + 5e-6, 1.0 - 3e-6]) + rng.normal([4e-6, -2e-6], 0.3e-6, (count, 2))
    rows = [f"R,{t:g},{r},{x:.9f},{z:.9f}" for t, r, (x, z) in zip(time_s, reference, signal, strict=True)]
    Path("r.csv").write_text("\n".join(["installation,time_s,reference_v,ux_v,uz_v", *rows]) + "\n")
    return "r.csv"


@pytest.mark.slow
def test_calibrate_gives_gain_and_offset_of_each_channel(bench, record):
    status, out, _ = bench("calibrate", record, "--json", "c.json")
    result = json.loads(Path("c.json").read_text(encoding="utf-8"))
    keeps_to("calibrate-record", result)
    assert (status, list(result["channels"])) == (0, ["x", "z"])
    x, z = result["channels"].values()
    assert abs(x["gain"]["value"] - 1.0 - 5e-6) < 2 * x["gain"]["U"]
    assert abs(z["offset_v"]["value"] + 2e-6) < 2 * z["offset_v"]["U"]
    assert "verdicts of |a| do not apply" in result["does_not_apply"][0]
    for told in ("channel x: gain", "channel z: gain", "scatter", "verdicts of |a| do not apply"):
        assert told in out, told
    from_python = program.calibrate(record)
    assert from_python.to_dict() == result
    assert "channel z: gain" in repr(from_python)


def test_report_is_a_page_with_the_noise_of_the_residuals(bench, record):
    assert bench("report", record, "--json", "r.json")[0] == 0
    result = json.loads(Path("r.json").read_text(encoding="utf-8"))
    keeps_to("report", result)
    assert result["verification"] is None
    page = Path(result["report"]).read_text(encoding="utf-8")
    assert page.count("<svg") == 2
    for told in ("hannel x: gain = 1.00000", "averages omit them", "end of the report"):
        assert told in page, told


def test_stability_handles_gaps_and_time_steps(bench, record):
    status, _, _ = bench("stability", record, "--json", "s.json")
    result = json.loads(Path("s.json").read_text(encoding="utf-8"))
    keeps_to("stability", result)
    assert (status, list(result["channels"])) == (0, ["x", "z"])
    # 0.3 µV a sample of 21.5 s, white: 0.3 µV at the first averaging time
    assert result["interval_s"] == pytest.approx(21.5, abs=0.1)
    for channel in result["channels"].values():
        assert channel["allan_deviation"][0] == pytest.approx(0.3e-6, rel=0.15)
        assert np.mean(channel["psd"]["density"]) == pytest.approx(2 * 21.5 * 0.09e-12, rel=0.2)
    assert result["reading"] is None
    assert any("have no reading; averages omit" in note for note in result["notes"])


def test_its_result_is_no_calibration_of_a_block(bench, record):
    """Neither for a command that takes coefficients, nor for panel and catalogue, which read its folder."""
    assert bench("import", record, "--name", "meters")[0] == 0
    assert bench("calibrate", "meters")[0] == 0
    assert "calibrates meters" in refused(bench("coefficients", "runs/meters/calibrate.json"))
    found = results_of(Run(Path("runs/meters")))
    assert found.trouble == ()
    assert [row.name for row in found.calibration.rows] == ["gain x", "offset x", "gain z", "offset z"]
    status, out, _ = bench("catalogue", "sync", "runs")
    assert status == 0
    assert "problem" not in out


@pytest.mark.parametrize("command", ["verify", "compensate", "tumble", "coefficients", "compare", "learn"])
def test_what_does_not_apply_says_so_in_a_sentence(bench, record, command):
    told = refused(bench(command, record))
    assert "a record at a known input" in told
    assert "'bench calibrate'" in told


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (("calibrate", "--estimator", "closed-form"), "leave out --estimator"),
        (("report", "--limit", "1e-4"), "leave out the options of the verdict"),
    ],
)
def test_options_of_a_block_are_refused(bench, record, asked, told):
    assert told in refused(bench(asked[0], record, *asked[1:]))
