"""Findings and the exit status that follows from them."""

import pytest

from bench.run.commission.session import Figure, Finding, State, status_of


def found(*states: State) -> list[Finding]:
    return [Finding("check", "head", state, "said") for state in states]


@pytest.mark.parametrize(
    ("states", "status"),
    [
        ([State.WORKS], 0),
        ([State.WORKS, State.SKIPPED], 0),
        ([State.WORKS, State.SLOWER], 1),
        ([State.OTHER, State.WORKS], 1),
        ([State.OTHER, State.COULD_NOT], 2),
        ([], 2),
    ],
)
def test_the_worst_decides_the_status(states, status):
    assert status_of(found(*states), whole=True) == status


def test_an_evening_that_was_not_gone_through_is_not_done():
    assert status_of(found(State.WORKS), whole=False) == 2


def test_a_figure_is_told_with_its_unit_and_what_it_was_held_against():
    assert Figure("took", 4.123456, "s", "4.1 s expected").text == "took 4.123 s (4.1 s expected)"
    assert Figure("mean", 1.0, "µV").text == "mean 1 µV"


def test_a_finding_is_one_sentence_with_what_to_do():
    finding = Finding("stop", "head", State.OTHER, "went on", remedy="do not use it")
    assert finding.sentence == "head: stop: went on; do not use it"
