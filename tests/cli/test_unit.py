"""`run --unit`, and `bench stability` on files and on a run."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Read
from bench.run.folder import Run
from bench.run.record import Record
from bench.services.errors import Refused
from bench.services.execution import new_run
from bench.services.requests.measuring import RunRequest
from bench.services.source import Request, load_sources
from drivers.clock import utc_now
from tests.support.commands import printed, refused
from tests.support.pages import ROOT

FINISHED = ROOT / "tests" / "data" / "records" / "finished"


def begun(unit):
    return new_run(RunRequest("quick", "paper-stand", dry_run=True, seed=1, name="one", unit=unit))


def test_the_run_is_of_the_unit_that_is_given_and_the_bench_files_is_told(empty_folder):
    new = begun(" 17-042 ")
    assert new.manifest["unit_under_test"]["serial"] == "17-042"
    stated = begun(None).manifest["unit_under_test"]
    assert new.manifest["unit_under_test"]["type"] == stated["type"]
    (note,) = new.notes
    assert "17-042" in note
    assert stated["serial"] in note
    assert begun(stated["serial"]).notes == begun(None).notes == ()


@pytest.mark.parametrize("unit", ["", "  ", "17\x1b[31m", "17\n18"])
def test_what_cannot_be_printed_is_no_serial_number(empty_folder, unit):
    with pytest.raises(Refused, match=r"unit .*serial number"):
        begun(unit)


def test_results_name_the_unit_of_the_run_and_say_where_its_bench_file_names_another(empty_folder):
    recorded = Run(FINISHED)
    stated = recorded.manifest["unit_under_test"]
    manifest = {**recorded.manifest, "unit_under_test": {**stated, "serial": "17-042"}}
    files = {name: (FINISHED / name).read_bytes() for name in manifest.pop("files")}
    with contextlib.closing(Record.create(Path("runs/one"), manifest, files, utc_now)) as record:
        for event in recorded.history.events:
            record.append(event.type, event.bench_s, **event.data)
    (source,) = load_sources(Request(["one"], Path("runs")))
    assert source.block_name == f"{stated['type']} 17-042"
    (note,) = [note for note in source.readings.notes if "17-042" in note]
    assert stated["serial"] in note


DATA = Path(__file__).parents[1] / "data"


def still(path, noise=1e-4, n=2000, interval_s=0.2):
    rng = np.random.default_rng(21)
    rows = np.column_stack([interval_s * np.arange(n), rng.normal([0.1, -0.2, -2.5], noise, (n, 3))])
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
    out = printed(bench("stability", still(tmp_path / "still.csv"), "--size", "2e-5", "--json", "s.json"))
    (line,) = (row for row in out.splitlines() if row.startswith("reading:"))
    shipped = Path(__file__).parents[2] / "procedures" / "quick.yaml"
    own = [line if row.startswith("reading:") else row for row in shipped.read_text().splitlines()]
    (tmp_path / "own.yaml").write_text("\n".join(own))
    reading = next(s for s in load_procedure(tmp_path / "own.yaml").plan.steps if isinstance(s, Read))
    told = json.loads((tmp_path / "s.json").read_text())["reading"]
    assert (reading.samples, reading.nplc) == (told["samples"], told["nplc"])
    assert 5.0 <= told["averaging_s"] <= 13.0


def test_a_size_that_is_not_reached_is_not_accepted(bench, tmp_path):
    printed(
        bench("stability", still(tmp_path / "still.csv"), "--size", "1e-9"),
        "the size asked for is not reached",
        status=1,
    )


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
        (("still.csv", "--size", "-1"), "--size -1.0: give a positive number"),
        (("still.csv", "--integration", "7"), "more than 0 and at most 0.2 s"),
    ],
)
def test_mistakes_are_one_line(bench, tmp_path, arguments, told):
    still(tmp_path / "still.csv")
    refused(bench("stability", *arguments), told)


def test_the_limit_in_a_message_is_accepted(bench, tmp_path):
    path = still(tmp_path / "still.csv", interval_s=0.2 / 2.9)  # 0.068966 s is rounded up to four digits
    refused(bench("stability", path, "--integration", "1"), "more than 0 and at most 0.06896 s")
    assert bench("stability", path, "--integration", "0.06896")[0] == 0


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
    refused(bench("stability", "turned"), "the block was turned in this run")
