"""`run --unit`: one bench file for many units, and whose readings they are."""

import contextlib
from pathlib import Path

import pytest

from bench.run.folder import Run
from bench.run.record import Record
from bench.services.errors import Refused
from bench.services.execution import new_run
from bench.services.requests.measuring import RunRequest
from bench.services.source import Request, load_sources
from drivers.clock import utc_now
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
