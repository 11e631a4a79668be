"""What is said before a run with a learned file: budget, and goals of `run --until`."""

import datetime
from pathlib import Path

import pytest

import bench as program
from bench.config.bench_file.file import FileMistakes, load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_procedure
from bench.services.errors import Refused
from bench.services.learned import learned_for_run
from bench.services.until import chooser_of, outlook_in_words, outlook_until
from drivers.clock import utc_now
from tests.support.learned_file import leave

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
    assert any("stands in place of the stated limits of the stand" in note for note in new)
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


def test_a_goal_below_the_floor_of_the_limits_is_reached_with_what_was_learned(empty_folder):
    """Kyx hangs on the zero offset, which no number of readings lowers."""
    leave()
    file, known = learned()
    with pytest.raises(Refused, match="no number of readings"):
        chooser_of(PAPER, file, GOAL)
    found = chooser_of(PAPER, file, GOAL, known)
    assert found.stand.known is known.known
    with pytest.raises(Refused, match="no number of readings") as refused:
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
