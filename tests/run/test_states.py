"""The states of a run and what leads from one to another."""

import pytest

from bench.run.events import ENDED, HEARD, TRANSITIONS, RunState, state_after


def test_the_table_of_transitions_has_no_dead_end_but_the_two_ends():
    reachable = {RunState.READY}
    for _ in RunState:
        reachable |= {after for state in reachable for after in TRANSITIONS[state].values()}
    assert reachable == set(RunState)
    assert {state for state in RunState if not TRANSITIONS[state]} == {RunState.FINISHED, RunState.ABORTED}
    assert set(HEARD) == {RunState.RUNNING, RunState.PAUSED}


@pytest.mark.parametrize("state", list(RunState))
def test_every_transition_leads_where_the_table_says_and_no_other_is_allowed(state):
    ways = {
        RunState.READY: [],
        RunState.RUNNING: ["run_started"],
        RunState.PAUSED: ["run_started", "run_paused"],
        RunState.FINISHED: ["run_started", "run_finished"],
        RunState.FAILED: ["run_started", "run_failed"],
        RunState.INTERRUPTED: ["run_started", "run_interrupted"],
        RunState.ABORTED: ["run_started", "run_aborted"],
    }
    way = ways[state]
    assert state_after(way) is state
    events = {event for row in TRANSITIONS.values() for event in row}
    for event in events:
        if event in TRANSITIONS[state]:
            assert state_after([*way, event]) is TRANSITIONS[state][event]
        else:
            with pytest.raises(ValueError, match="cannot follow"):
                state_after([*way, event])


@pytest.mark.parametrize("stopped", ["run_failed", "run_interrupted"])
@pytest.mark.parametrize("attempt", ["run_failed", "run_interrupted"])
def test_an_attempt_to_go_on_that_fails_leaves_a_run_as_it_was(stopped, attempt):
    """Records that earlier versions wrote so are read as what they are."""
    before = state_after(["run_started", stopped])
    assert state_after(["run_started", stopped, attempt, attempt]) is before
    assert state_after(["run_started", stopped, attempt, "run_resumed"]) is RunState.RUNNING


@pytest.mark.parametrize("state", [state for state in RunState if state not in ENDED])
def test_whatever_a_program_left_a_run_at_another_takes_it_up_or_ends_it(state):
    assert TRANSITIONS[state]["run_resumed"] is RunState.RUNNING
    assert TRANSITIONS[state]["run_aborted"] is RunState.ABORTED
