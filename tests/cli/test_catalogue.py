"""The catalogue from the command line: sync, questions, a unit, what is due."""

import contextlib
import csv
import json
import random
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from tests.support.laboratory import write_run
from tests.support.schemas import keeps_to

RECORDS = Path(__file__).parents[1] / "data" / "records"
DRIFT_V = np.array([0.0] * 9 + [6e-5, 0.0, 0.0])


@pytest.fixture
def laboratory(empty_folder, monkeypatch):
    """Two units and two benches; from May on meter MY2 is on the other bench."""
    monkeypatch.setenv("TRIAXIAL_BENCH_CATALOGUE", "laboratory.sqlite")
    for year in range(2020, 2026):
        created = f"{year}-03-01T08:00:00+00:00"
        write_run(Path("runs") / f"a-{year}", serial="17", created=created, shift=DRIFT_V * (year - 2020))
    moved = {"bench": "bench-02", "meters": ("MY4", "MY2", "MY6"), "created": "2026-05-20T08:00:00+00:00"}
    write_run(Path("runs") / "b-1", serial="18", created="2026-05-01T08:00:00+00:00")
    write_run(Path("runs") / "b-2", serial="18", verdict="fail", effects=("cable_torque",), **moved)


@pytest.fixture
def synced(laboratory, bench):
    status, out, _ = bench("catalogue", "sync", "runs")
    assert (status, "8 new" in out) == (0, True)
    return bench


def test_which_units_were_measured_with_a_meter_after_a_day(synced):
    status, out, _ = synced(
        "catalogue", "ask", "meter=MY2", "after=2026-05-03", "--of", "units", "--json", "a.json"
    )
    assert status == 0
    found = json.loads(Path("a.json").read_text())
    keeps_to("catalogue-ask", found)
    assert [(row["unit"], row["runs"], row["failed"]) for row in found["rows"]] == [("block A 18", 1, 1)]
    assert "block A 18" in out


@pytest.mark.parametrize(
    ("query", "names"),
    [
        ("unit=18", ["b-1", "b-2"]),
        ("unit=block*18 verdict=failed", ["b-2"]),
        ("verdict!=pass", ["b-2"]),
        ("effect=cable_torque", ["b-2"]),
        ("diagnosis=none unit=18", ["b-1"]),
        ("certificate=2026-MY4", ["b-2"]),
        ("instrument=manual*bench-02", ["b-2"]),
        ("before=2021-01-01", ["a-2020"]),
        ("created>2026-05-01T08:00+00:00", ["b-2"]),
        ("bench!=bench-01", ["b-2"]),
        ("simulated=yes", []),
        ("temperature>23 readings>=1 name=b-*", ["b-1", "b-2"]),
        ("delta_g>2e-4", []),
        ("operator=%", []),
        ("operator=a.*", []),
    ],
)
def test_questions(synced, query, names):
    _, out, _ = synced("catalogue", "ask", *query.split(), "--json", "-")
    assert [row["name"] for row in json.loads(out)["rows"]] == names


def test_all_mistakes_of_a_question_are_told_at_once(synced):
    status, _, err = synced("catalogue", "ask", "metre=1", "unit", "after=soon", "p>often", "verdict>pass")
    assert status == 2
    assert err.count("\n") == 5
    assert "no key metre" in err


def test_rows_as_csv_and_parquet(synced):
    parquet = pytest.importorskip("pyarrow.parquet")
    synced("catalogue", "ask", "--of", "coefficients", "--csv", "c.csv", "--parquet", "c.parquet")
    with Path("c.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert float(rows[0]["Kxx"]) == -2.177
    assert float(rows[0]["u_Kxx"]) == pytest.approx(2e-5, rel=1e-12)
    table = parquet.read_table("c.parquet").to_pylist()
    assert [row["name"] for row in table] == [row["name"] for row in rows]
    assert table[5]["U0x"] == pytest.approx(0.071 + 3e-4, rel=1e-12)


def test_a_unit_that_drifts_is_due_by_its_drift_and_has_a_page(synced):
    status, out, _ = synced("catalogue", "unit", "17", "--page", "unit.html", "--json", "unit.json")
    found = json.loads(Path("unit.json").read_text())
    keeps_to("catalogue-unit", found)
    assert status == 0
    assert found["due"]["basis"] == "drift"
    assert "2026" <= found["due"]["due"][:4] <= "2036"
    assert len(found["calibrations"]) == 6
    page = Path("unit.html").read_text()
    assert "block A 17" in page
    assert "<svg" in page
    assert "SIMULATED" not in page + out


def test_a_short_history_is_due_by_the_interval_and_says_so(synced):
    _, out, _ = synced("catalogue", "due", "--interval", "100", "--json", "due.json")
    found = json.loads(Path("due.json").read_text())
    keeps_to("catalogue-due", found)
    (row,) = (one for one in found["units"] if one["unit"] == "block A 18")
    assert (row["due"], row["basis"]) == ("2026-08-28", "interval")
    assert "the interval of 100 days counts" in row["why"]
    assert "2 units due" in out
    _, out, _ = synced("catalogue", "due", "--before", "2026-08-28", "--interval", "100", "--json", "-")
    assert "block A 18" not in [one["unit"] for one in json.loads(out)["units"]]


def test_real_calibrations_are_not_mixed_with_simulated_ones(synced):
    write_run(Path("runs") / "dry", serial="17", simulated=True, created="2026-06-01T08:00:00+00:00")
    synced("catalogue", "sync", "runs", "--json", "sync.json")
    keeps_to("catalogue-sync", json.loads(Path("sync.json").read_text()))
    _, out, _ = synced("catalogue", "unit", "17")
    assert "7 runs, 6 calibrations compared" in out
    assert "without 1 calibrations of simulated runs" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("unit 99", "no such unit"),
        ("unit 1*", "name one unit"),
        ("unit 17 --limit 0", "expected a number above zero"),
        ("ask --of people", "known are runs"),
        ("sync nowhere", "no such folder"),
        ("sync runs --catalogue mysql://host/name", "stands in PostgreSQL"),
        ("sync runs --catalogue runs", "is a folder"),
        ("ask --catalogue none.sqlite", "there is no catalogue yet"),
        ("ask --catalogue runs/a-2020/run.json", "not a catalogue"),
    ],
)
def test_what_cannot_be_done_is_a_sentence(synced, words, said):
    status, _, err = synced("catalogue", *words.split())
    assert (status, said in err) == (2, True), err


def test_keys_are_listed(bench):
    _, out, _ = bench("catalogue", "keys")
    assert "begun on that day or later" in out


@pytest.mark.slow
def test_a_damaged_catalogue_says_so_and_what_to_do(bench):
    """Bytes overwritten (random, seed 1), a file cut short, a table lost: the remedy is named, or it works."""
    shutil.copytree(RECORDS / "finished", Path("runs/a"))
    file = Path("c.sqlite")
    assert bench("catalogue", "sync", "runs", "--catalogue", file)[0] == 0
    good, draw = file.read_bytes(), random.Random(1)  # noqa: S311 - nothing secret
    refused = 0
    for number in range(24):
        spoilt = bytearray(good)
        for _ in range(draw.choice((1, 30, 2000))):
            spoilt[draw.randrange(len(good))] = draw.randrange(256)
        for beside in Path().glob("c.sqlite*"):
            beside.unlink()
        file.write_bytes(spoilt[: draw.randrange(len(good))] if number % 4 == 0 else spoilt)
        if number % 4 == 1:
            file.write_bytes(good)
            with contextlib.closing(sqlite3.connect(file)) as opened:
                opened.execute(f"DROP TABLE {draw.choice(('runs', 'calibrations', 'verifications'))}")
                opened.commit()
        status, _, err = bench("catalogue", "ask", "--catalogue", file)
        assert status in {0, 1, 2}
        assert "mistake of the program" not in err
        if status == 2:
            refused += 1
            assert "make it again with: bench catalogue sync DIR" in err
    assert refused >= 6


def test_a_date_of_a_catalogue_that_is_none_is_damage(synced):
    assert synced("catalogue", "sync", "runs", "--catalogue", "c.sqlite")[0] < 2
    with sqlite3.connect("c.sqlite") as damaged:
        damaged.execute("UPDATE runs SET created = '2026-11-22 02''11:14.876839'")
    status, _, err = synced("catalogue", "ask", "--catalogue", "c.sqlite")
    assert (status, "a damaged one" in err) == (2, True), err
