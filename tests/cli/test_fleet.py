"""Many units on many benches from the command line: bench or block, equivalence, a prior, drift, capability."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.model.geometry import COEFFICIENTS
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
    assert any("what a unit changed by" in note for note in told["notes"])
    (both,) = told["together"]["pairs"]
    assert (both["dof"], both["apart"]) == (12, True)
    assert both["chi2"] > (pair["difference"] / pair["u"]) ** 2
    assert "all twelve together, bench-01 and bench-02: chi2" in out
    assert "<svg" in Path("there/equivalence.svg").read_text(encoding="utf-8")
    assert json.loads(Path("there/fleet-compare.json").read_text()) == told


def test_a_reference_that_there_is_not_is_told(laboratory):
    status, _, err = laboratory("fleet", "compare", "--reference", "median")
    assert status == 2
    assert "--reference median: known are weighted-mean, mandel-paule, dersimonian-laird" in err


def test_simulated_and_real_are_not_mixed(laboratory):
    write_run(Path("further") / "dry", serial="1", simulated=True)
    laboratory("catalogue", "sync", "further")
    status, _, err = laboratory("fleet", "effects")
    assert status == 2
    assert "1 of 25 calibrations are simulated: ask for simulated=yes or simulated=no" in err


def test_a_units_history_and_what_is_expected_of_it(laboratory):
    _, out, told = result(laboratory, "drift", "unit=3", "--at", "2027-01-01")
    assert told["calibrations"] == 3
    assert any("differences between benches pass for a drift" in note for note in told["notes"])
    expected = told["expected"]["coefficients"]["Kxx"]
    assert abs(expected["value"] - VECTOR[0]) < 1e-3
    assert expected["u"] > U
    assert "at 2027-01-01" in out
    status, _, err = laboratory("fleet", "drift")
    assert (status, "the question names 8: add unit=" in err) == (2, True)


def test_the_capability_holds_what_benches_differ_by(laboratory):
    _, _, told = result(laboratory, "cmc")
    rows = told["coefficients"]
    assert rows["Kyy"]["between_benches"]["value"] > 2 * U
    assert rows["Kyy"]["U"] > rows["Kzz"]["U"] >= 2 * U
    status, _, err = laboratory("fleet", "cmc", "after=2025-09-01")
    assert status == 2
    assert "8 calibrations (20 are needed); 0 repeated" in err


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
    status, _, err = bench("calibrate", "first", "--prior", "prior.yaml")
    assert (status, "is of type 'another', the unit here is of type" in err) == (2, True)
    text["covariance"][0][1] = 1.0
    Path("prior.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    status, _, err = bench("calibrate", "first", "--prior", "prior.yaml")
    assert (status, "is no covariance" in err) == (2, True)
