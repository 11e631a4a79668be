"""Many units on many benches from the command line: `bench fleet` and the catalogue that it asks."""

import contextlib
import csv
import json
import random
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import yaml

from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.model.geometry import COEFFICIENTS
from tests.support.commands import printed, refused
from tests.support.laboratory import VECTOR, U, write_run
from tests.support.schemas import keeps_to

KYY = COEFFICIENTS.index("Kyy")
OFF_V = 8 * U
"""What bench-02 is off by in Kyy."""


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory):
    """Eight units, thrice each on two benches within a year; errors as stated, units differ by 2e-4 V."""
    folder = tmp_path_factory.mktemp("laboratory")
    rng = np.random.default_rng(11)
    for unit in range(8):
        own = 2e-4 * rng.normal(size=12)
        for k in range(3):
            shift = own + U * rng.normal(size=12)
            stand = (unit + k) % 2
            shift[KYY] += OFF_V * stand
            write_run(
                folder / f"{unit}-{k}", serial=str(unit), bench=f"bench-0{stand + 1}", shift=shift,
                created=f"2025-{4 * k + 1:02}-1{unit}T08:00:00+00:00",
                meters=(f"A{stand}", f"B{stand}", f"C{stand}"),
            )  # fmt: skip
    with open_catalogue(folder / "laboratory.sqlite") as opened:
        assert sync(opened, [folder], processes=1).added == 24
    return folder / "laboratory.sqlite"


@pytest.fixture
def laboratory(catalogue, empty_folder, monkeypatch, bench):
    """The command line over a catalogue of its own of that laboratory."""
    shutil.copy(catalogue, "laboratory.sqlite")
    monkeypatch.setenv("TRIAXIAL_BENCH_CATALOGUE", "laboratory.sqlite")
    return bench


def result(bench, *words):
    status, out, err = bench("fleet", *words, "--json", "result.json")
    assert status < 2, err
    told = json.loads(Path("result.json").read_text())
    keeps_to(f"fleet-{words[0]}", told)
    return status, out, told


@pytest.mark.slow
def test_the_bench_that_is_off_is_named_and_the_blocks_are_not(laboratory):
    _, out, told = result(laboratory, "effects", "type=block A")
    assert told["answer"].startswith("both: benches differ in Kyy")
    assert {row["coefficient"] for row in told["benches_apart"]} == {"Kyy"}
    assert told["answer"] in " ".join(out.split())
    effect = told["benches_effects"]["bench-02"]["Kyy"]
    assert abs(effect["effect"] - OFF_V / 2) < 4 * effect["u"]
    found = [row["unit"] for row in told["coefficients"].values()]
    # of eight units, chi-square of seven: below 0.2 or above 1.8 of the truth once in 10,000 times
    assert all(4e-5 < size["value"] < 3.6e-4 < 6 * size["at_most"] for size in found)


def test_degrees_of_equivalence_with_figure_and_exit_status(laboratory):
    status, out, told = result(
        laboratory, "compare", "--out", "there", "--reference", "weighted-mean", "--strict"
    )
    assert status == 1
    assert {row["coefficient"] for row in told["apart"]} == {"Kyy"}
    (pair,) = told["coefficients"]["Kyy"]["pairs"]
    assert (pair["first"], pair["second"], pair["units"]) == ("bench-01", "bench-02", 8)
    assert abs(abs(pair["difference"]) - OFF_V) < 4 * pair["u"]
    assert any("changes of a unit" in note for note in told["notes"])
    (both,) = told["together"]["pairs"]
    assert (both["dof"], both["apart"]) == (12, True)
    assert both["chi2"] > (pair["difference"] / pair["u"]) ** 2
    assert "all twelve together, bench-01 and bench-02: chi2" in out
    assert {row["coefficient"] for row in told["intrinsic"]["beyond"]} >= {"Sy"}
    (pair,) = told["intrinsic"]["together"]["pairs"]
    assert (pair["dof"], pair["apart"]) == (9, True)
    assert "all nine together, bench-01 and bench-02: chi2" in out
    assert "<svg" in Path("there/equivalence.svg").read_text(encoding="utf-8")
    assert json.loads(Path("there/fleet-compare.json").read_text()) == told


def test_a_reference_that_there_is_not_is_told(laboratory):
    refused(
        laboratory("fleet", "compare", "--reference", "median"),
        "--reference median: choose from weighted-mean, mandel-paule, dersimonian-laird",
    )


def test_simulated_and_real_are_not_mixed(laboratory):
    write_run(Path("further") / "dry", serial="1", simulated=True)
    laboratory("catalogue", "sync", "further")
    refused(
        laboratory("fleet", "effects"),
        "1 of 25 calibrations are simulated, the others real; add simulated=yes or simulated=no",
    )


def test_a_units_history_and_what_is_expected_of_it(laboratory):
    _, out, told = result(laboratory, "drift", "unit=3", "--at", "2027-01-01")
    assert told["calibrations"] == 3
    assert any("differences between benches appear as drift" in note for note in told["notes"])
    expected = told["expected"]["coefficients"]["Kxx"]
    assert abs(expected["value"] - VECTOR[0]) < 1e-3
    assert expected["u"] > U
    of_nine = told["expected"]["intrinsic"]["Sx"]
    assert abs(of_nine["value"] + VECTOR[0]) < 2e-3
    assert len(told["intrinsic_per_year"]) == 9
    assert told["drifts"] == (told["p"] < 0.05)
    assert "at 2027-01-01" in out
    refused(laboratory("fleet", "drift"), "the conditions match 8 units, but a drift is of one; add unit=")


@pytest.mark.slow
def test_the_capability_holds_what_benches_differ_by(laboratory):
    _, _, told = result(laboratory, "cmc")
    rows = told["coefficients"]
    assert rows["Kyy"]["between_benches"]["value"] > 2 * U
    assert rows["Kyy"]["U"] > rows["Kzz"]["U"] >= 2 * U
    refused(laboratory("fleet", "cmc", "after=2025-09-01"), "8 calibrations (20 are needed); 0 repeated")


def write_others(made, dry_vector):
    """Write runs of seven simulated units about the coefficients of a dry run."""
    rng = np.random.default_rng(5)
    for unit in range(7):
        shift = dry_vector - VECTOR + 1e-3 * rng.normal(size=12)
        where = Path("others") / str(unit)
        write_run(where, serial=f"other {unit}", kind=made["type"], simulated=True, shift=shift)


@pytest.mark.slow
def test_a_calibration_with_the_prior_of_its_type(empty_folder, monkeypatch, bench, dry_run_of_paper):
    monkeypatch.setenv("TRIAXIAL_BENCH_CATALOGUE", "laboratory.sqlite")
    shutil.copytree(dry_run_of_paper, "runs/first")
    alone = json.loads(Path("runs/first/calibrate.json").read_text())
    vector = np.array([alone["coefficients"][name]["value"] for name in COEFFICIENTS])
    write_others(alone["unit_under_test"], vector)
    bench("catalogue", "sync", "others")
    _, _, told = result(bench, "prior", "--prior-out", "prior.yaml")
    assert yaml.safe_load(Path("prior.yaml").read_text(encoding="utf-8")) == told
    assert (len(told["units"]), told["simulated"]) == (7, True)

    def calibrated(*more):
        status, out, err = bench("calibrate", "first", "--prior", "prior.yaml", "--json", "c.json", *more)
        assert status < 2, err
        found = json.loads(Path("c.json").read_text())
        keeps_to("calibrate", found)
        return out, found

    _, found = calibrated()
    assert found["prior"]["used"] is True
    for name in COEFFICIENTS:
        assert found["coefficients"][name]["u"] <= found["prior"]["u_without"][name]
    assert "prior" not in json.loads(Path("runs/first/calibrate.json").read_text())

    text = yaml.safe_load(Path("prior.yaml").read_text(encoding="utf-8"))
    text["coefficients"]["Kxy"]["mean"] += 0.1
    Path("prior.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    out, found = calibrated()
    assert found["prior"]["used"] is False
    assert "NOT USED" in out
    assert found["coefficients"] == alone["coefficients"]

    text["type"] = "another"
    Path("prior.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    refused(
        bench("calibrate", "first", "--prior", "prior.yaml"),
        "the prior is for units of type 'another', but this unit is of type",
    )
    text["covariance"][0][1] = 1.0
    Path("prior.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    refused(bench("calibrate", "first", "--prior", "prior.yaml"), "the matrix is no covariance")


RECORDS = Path(__file__).parents[1] / "data" / "records"
DRIFT_V = np.array([0.0] * 9 + [6e-5, 0.0, 0.0])


@pytest.fixture(scope="module")
def catalogued(tmp_path_factory):
    """A laboratory and its catalogue: two units and two benches; from May on meter MY2 is on the other bench."""
    folder = tmp_path_factory.mktemp("laboratory")
    with contextlib.chdir(folder), open_catalogue("laboratory.sqlite") as catalogue:
        write_runs()
        assert sync(catalogue, ["runs"], processes=1).added == 8
    return folder


def write_runs():
    for year in range(2020, 2026):
        created = f"{year}-03-01T08:00:00+00:00"
        write_run(Path("runs") / f"a-{year}", serial="17", created=created, shift=DRIFT_V * (year - 2020))
    moved = {"bench": "bench-02", "meters": ("MY4", "MY2", "MY6"), "created": "2026-05-20T08:00:00+00:00"}
    write_run(Path("runs") / "b-1", serial="18", created="2026-05-01T08:00:00+00:00")
    write_run(Path("runs") / "b-2", serial="18", verdict="fail", effects=("cable_torque",), **moved)


@pytest.fixture
def synced(catalogued, empty_folder, monkeypatch, bench):
    """The command line over a catalogue of its own of that laboratory."""
    monkeypatch.setenv("TRIAXIAL_BENCH_CATALOGUE", "laboratory.sqlite")
    shutil.copytree(catalogued, ".", dirs_exist_ok=True)
    return bench


def test_which_units_were_measured_with_a_meter_after_a_day(synced):
    out = printed(
        synced("catalogue", "ask", "meter=MY2", "after=2026-05-03", "--of", "units", "--json", "a.json")
    )
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
    asked = ("metre=1", "unit", "after=soon", "p>often", "verdict>pass")
    refused(synced("catalogue", "ask", *asked), "no key metre", lines=5)


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
    assert "the interval of 100 days applies" in row["why"]
    assert "2 units due" in out
    _, out, _ = synced("catalogue", "due", "--before", "2026-08-28", "--interval", "100", "--json", "-")
    assert "block A 18" not in [one["unit"] for one in json.loads(out)["units"]]


@pytest.mark.slow
def test_real_calibrations_are_not_mixed_with_simulated_ones(synced):
    Path("laboratory.sqlite").unlink()
    assert "8 new" in synced("catalogue", "sync", "runs")[1]
    write_run(Path("runs") / "dry", serial="17", simulated=True, created="2026-06-01T08:00:00+00:00")
    synced("catalogue", "sync", "runs", "--json", "sync.json")
    keeps_to("catalogue-sync", json.loads(Path("sync.json").read_text()))
    _, out, _ = synced("catalogue", "unit", "17")
    assert "7 runs, 6 calibrations compared" in out
    assert "K per local g of the last calibration, 9.81" in out
    assert "without 1 calibrations of simulated runs" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("unit 99", "no such unit"),
        ("unit 1*", "give the name of one unit"),
        ("unit 17 --limit 0", "give a number above zero"),
        ("ask --of people", "choose from runs"),
        ("sync nowhere", "no such folder"),
        ("sync runs --catalogue mysql://host/name", "in PostgreSQL"),
        ("sync runs --catalogue runs", "is a folder"),
        ("ask --catalogue none.sqlite", "no catalogue yet"),
        ("ask --catalogue runs/a-2020/run.json", "not a catalogue"),
    ],
)
def test_what_cannot_be_done_is_a_sentence(synced, words, said):
    refused(synced("catalogue", *words.split()), said)


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
        assert "error of the program" not in err
        if status == 2:
            refused += 1
            assert f"make it again with 'bench catalogue sync DIR --catalogue {file}'" in err
    assert refused >= 6


def test_a_date_of_a_catalogue_that_is_none_is_damage(synced):
    assert synced("catalogue", "sync", "runs", "--catalogue", "c.sqlite")[0] < 2
    with sqlite3.connect("c.sqlite") as damaged:
        damaged.execute("UPDATE runs SET created = '2026-11-22 02''11:14.876839'")
    refused(synced("catalogue", "ask", "--catalogue", "c.sqlite"), "a damaged one")
