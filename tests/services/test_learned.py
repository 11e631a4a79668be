"""What is said before a run with a learned file: budget, and goals of `run --until`."""

import datetime
import json
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.base.arrays import ARCSEC, u_of
from bench.config.bench_file.file import FileMistakes, load_bench
from bench.config.bench_file.learned import arcsec
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_procedure
from bench.model.geometry import COEFFICIENTS
from bench.run.events import RecordError
from bench.run.folder import LEARNED, Run
from bench.services.check_block import check_values
from bench.services.errors import Refused
from bench.services.traceability import learned_for_run
from bench.services.until import chooser_of, outlook_in_words, outlook_until
from drivers.clock import utc_now
from tests.support.check_runs import dry_run
from tests.support.learned_file import content, leave

PAPER = load_procedure(find_procedure("paper")).expand()
GOAL = ["Kyx=1.2e-5"]


def learned(day=None, *, simulated=True):
    now = utc_now() if day is None else datetime.datetime.combine(day, datetime.time(12))
    file = load_bench(Path("mine.yaml"))
    return file, learned_for_run(file, Path("mine.yaml"), now.isoformat(), simulated=simulated)


def test_a_budget_takes_what_was_learned_and_says_so(empty_folder):
    leave()
    told = program.budget("mine.yaml", "paper", trials=0).to_dict()
    plain = program.budget("plain.yaml", "paper", trials=0).to_dict()
    assert told["coefficients"]["Kyz"]["u"] < plain["coefficients"]["Kyz"]["u"] / 2
    new = set(told["notes"]) - set(plain["notes"])
    assert any("replaces the stated limits of the stand" in note for note in new)
    assert any("come from simulated runs" in note for note in new)


def test_a_budget_keeps_the_rules_of_a_calibration(empty_folder):
    leave(expires="2026-02-01")
    old = program.budget("mine.yaml", "paper", trials=0).to_dict()
    plain = program.budget("plain.yaml", "paper", trials=0).to_dict()
    assert old["coefficients"] == plain["coefficients"]
    assert any("is not used: it expired on 2026-02-01" in note for note in old["notes"])
    leave(learned_for="of another")
    with pytest.raises(FileMistakes, match="with another stand"):
        program.budget("mine.yaml", "paper", trials=0)


@pytest.mark.slow
def test_a_goal_below_the_floor_of_the_limits_is_reached_with_what_was_learned(empty_folder):
    """Kyx hangs on the zero offset, which no number of readings lowers."""
    leave()
    file, known = learned()
    with pytest.raises(Refused, match="readings at these points cannot lower"):
        chooser_of(PAPER, file, GOAL)
    found = chooser_of(PAPER, file, GOAL, known)
    assert found.stand.known is known.known
    with pytest.raises(Refused, match="readings at these points cannot lower") as refused:
        chooser_of(PAPER, file, ["Kyx=5e-6"], known)
    assert "stand means" in str(refused.value)
    words = outlook_in_words(outlook_until(PAPER, file, GOAL, known))
    assert words.startswith("at the noise that was learned: ")


def test_neither_an_expired_file_nor_one_of_simulated_runs_counts_for_a_real_run(empty_folder):
    leave()
    _, real = learned(simulated=False)
    _, late = learned(datetime.date(2126, 2, 1))
    for taken, why in ((real, "it comes from simulated runs"), (late, "it expired on 2126-01-01")):
        assert taken.known is None
        assert why in taken.notes[0]


KYX = COEFFICIENTS.index("Kyx")


def worse():
    """A learned stand whose remounts are ten times as large."""
    stand = content()["stand"]
    return {**stand, "remount": {kind: arcsec(30.0 * ARCSEC) for kind in stand["remount"]}}


@pytest.fixture
def measured(empty_folder, monkeypatch):
    """Measure with the bench file as it is then, seed 5 each time; the cache is this folder's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(Path("cache").absolute()))

    def run(name):
        return dry_run("quick", "mine.yaml", Path("runs"), name, 5)

    return run


@pytest.mark.slow
def test_a_chart_keeps_to_what_was_learned_when_the_check_was_measured(measured):
    """What is kept goes by the head of the record, in which the copy of the learned file is bound."""
    leave()
    first = measured("first")
    before = check_values(first)
    leave(stand=worse())
    second = measured("second")
    np.testing.assert_array_equal(check_values(first).readings, before.readings)
    np.testing.assert_array_equal(
        program.calibrate("runs/first").calibration.covariance_readings, before.readings
    )
    after = check_values(second)
    assert u_of(after.readings)[KYX] > 2 * u_of(before.readings)[KYX]
    # a copy that was changed is no record any more, though values of it are kept
    copy = first.folder / LEARNED
    copy.write_bytes((second.folder / LEARNED).read_bytes())
    with pytest.raises(RecordError, match=r"learned\.yaml"):
        check_values(Run(first.folder))


@pytest.mark.slow
def test_a_fleet_of_benches_with_learned_files_has_their_u(bench, empty_folder, monkeypatch):
    """Two units on two benches, one with what was learned, one by its limits: compared by what each states.

    Both read the same voltages, so that nothing but what was learned tells them apart.
    """
    monkeypatch.setenv("TRIAXIAL_BENCH_CATALOGUE", "laboratory.sqlite")
    leave()
    for name in ("mine", "plain"):
        text = Path(f"{name}.yaml").read_text(encoding="utf-8")
        Path(f"{name}.yaml").write_text(text.replace("name: paper-stand", f"name: {name}"), encoding="utf-8")
        for unit in "12":
            words = ("run", "quick", "--dry-run", "--seed", unit, "--bench", f"{name}.yaml", "--unit", unit)
            status, _, err = bench(*words, "--name", f"{name}-{unit}")
            assert status < 2, err
    assert bench("catalogue", "sync", "runs")[0] == 0
    status, _, err = bench("fleet", "compare", "simulated=yes", "--json", "found.json")
    assert status < 2, err
    told = json.loads(Path("found.json").read_text(encoding="utf-8"))
    (pair,) = told["coefficients"]["Kyx"]["pairs"]
    assert {pair["first"], pair["second"]} == {"mine", "plain"}
    u = {}
    for name in ("mine", "plain"):
        result = json.loads(Path(f"runs/{name}-1/calibrate.json").read_text(encoding="utf-8"))
        u[name] = result["coefficients"]["Kyx"]["u"]
        said = any("replaces the stated limits" in note for note in result["notes"])
        assert said == (name == "mine")
    assert u["mine"] < u["plain"]
