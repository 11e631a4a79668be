"""bench stability on files and on a run."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Read

DATA = Path(__file__).parents[1] / "data"


def still(path, noise=1e-4, n=2000):
    rng = np.random.default_rng(21)
    rows = np.column_stack([0.2 * np.arange(n), rng.normal([0.1, -0.2, -2.5], noise, (n, 3))])
    np.savetxt(path, rows, delimiter=",", header="time_s,ux_v,uy_v,uz_v", comments="", fmt="%.9f")
    return path


@pytest.mark.slow
@pytest.mark.figures
def test_the_real_record_is_analysed_written_and_drawn(bench, tmp_path):
    status, out, err = bench("stability", DATA / "ln100-up.csv", "--out", tmp_path, "--json", "found.json")
    assert (status, err) == (0, "")
    assert "19217 samples" in out
    assert "vibration or another line" in out
    result = json.loads((tmp_path / "found.json").read_text())
    assert result == json.loads((tmp_path / "ln100-up.json").read_text())
    assert result["channels"]["x"]["terms"]["Q"]["value"] > 0
    assert (tmp_path / "ln100-up.svg").read_text().startswith("<?xml")


def test_the_line_it_prints_goes_into_a_procedure(bench, tmp_path):
    """White noise of 1e-4 V in 0.2 s: 2e-5 V takes 5 s and, to be sure of it, up to twice that."""
    status, out, _ = bench("stability", still(tmp_path / "still.csv"), "--size", "2e-5", "--json", "s.json")
    assert status == 0
    (line,) = (row for row in out.splitlines() if row.startswith("reading:"))
    shipped = Path(__file__).parents[2] / "procedures" / "quick.yaml"
    own = [line if row.startswith("reading:") else row for row in shipped.read_text().splitlines()]
    (tmp_path / "own.yaml").write_text("\n".join(own))
    reading = next(s for s in load_procedure(tmp_path / "own.yaml").plan.steps if isinstance(s, Read))
    told = json.loads((tmp_path / "s.json").read_text())["reading"]
    assert (reading.samples, reading.nplc) == (told["samples"], told["nplc"])
    assert 5.0 <= told["averaging_s"] <= 13.0


def test_a_size_that_is_not_reached_is_not_accepted(bench, tmp_path):
    status, out, _ = bench("stability", still(tmp_path / "still.csv"), "--size", "1e-9")
    assert status == 1
    assert "the size asked for is not reached" in out


@pytest.mark.slow
def test_samples_that_integrate_a_part_of_the_time_shorten_the_reading(bench, tmp_path):
    path = still(tmp_path / "still.csv")
    assert bench("stability", path, "--size", "2e-5", "--json", "all.json")[0] == 0
    assert bench("stability", path, "--size", "2e-5", "--integration", "0.02", "--json", "part.json")[0] == 0
    whole, part = (
        json.loads((tmp_path / name).read_text())["reading"]["averaging_s"]
        for name in ("all.json", "part.json")
    )
    assert part == pytest.approx(whole / 10, rel=0.25)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("nothing.csv",), "nothing.csv: no such file"),
        (("nothing",), "nothing: no run of that name"),
        (("still.csv", "--size", "-1"), "--size -1.0: a size is a positive number"),
        (("still.csv", "--integration", "7"), "cannot integrate longer than the 0.2 s"),
    ],
)
def test_mistakes_are_one_line(bench, tmp_path, arguments, told):
    still(tmp_path / "still.csv")
    status, _, err = bench("stability", *arguments)
    assert status == 2
    assert told in err
    assert err.count("\n") == 1


PROCEDURE = """\
procedure: short
title: A short static record
reading: {samples: 4, nplc: 1, settle: 1 s}
steps:
  - installation:
      label: 1
      steps:
        - turn:
            angles: [0 deg]
            steps:
              - read: {times: 40, pause: 2 s}
"""


@pytest.mark.slow
def test_a_run_at_one_setting_is_a_record_and_knows_how_long_it_integrated(bench, tmp_path):
    (tmp_path / "short.yaml").write_text(PROCEDURE)
    bench("run", "short.yaml", "--dry-run", "--name", "short")
    status, out, err = bench("stability", "short", "--size", "1e-4", "--json", "s.json")
    assert (status in {0, 1}, err) == (True, "")
    result = json.loads((tmp_path / "s.json").read_text())
    assert result["samples"] == 40
    # 4 samples of a cycle at 50 Hz, of the two seconds and more between readings
    longest = max(channel["averaging"]["tau_s"] for channel in result["channels"].values())
    integrated = longest * 0.08 / result["interval_s"]
    assert result["reading"]["averaging_s"] == pytest.approx(max(integrated, 0.2), rel=0.3)
    assert (tmp_path / "runs" / "short" / "stability.svg").is_file()
    assert "Static record short" in out


def test_a_run_in_which_the_block_was_turned_is_refused(bench, tmp_path):
    (tmp_path / "turned.yaml").write_text(
        PROCEDURE.partition("        - turn:")[0] + "        - turn: {angles: [0 deg, 45 deg]}\n"
    )
    bench("run", "turned.yaml", "--dry-run", "--name", "turned")
    status, _, err = bench("stability", "turned")
    assert status == 2
    assert "the block was turned in this run" in err
