"""Each row of the table of events has its tests, and these exist."""

import ast
import re

import pytest

from tests.support.pages import DOCS, ROOT

TEXT = (DOCS / "when-something-happens.md").read_text(encoding="utf-8")
LINES = [line.strip("| ").split(" | ") for line in TEXT.splitlines() if line.startswith("| ")]
EVENTS = [[cell.strip() for cell in row] for row in LINES if row[0].strip() != "event"]
WANTED = (
    "chamber lost", "head lost", "voltmeter lost", "power cut", "closed terminal", "Ctrl-C once", "Ctrl-C again",
    "suspended", "clock set", "full disk", "second program", "chamber that does not move", "moves away",
    "outside its limits", "stalls", "reads the output",
)  # fmt: skip
HELD = """
chamber lost
    run/test_way_out.py test_whatever_an_instrument_raises_the_others_are_let_go_and_the_first_cause_stays
head lost
    drivers/test_acutrol.py test_a_silent_controller_is_lost_and_the_table_stopped_over_a_new_connection
voltmeter lost
    run/test_runner.py test_a_failed_reading_is_met_as_its_step_says
    drivers/wire/test_visa.py test_instrument_that_is_gone_for_good_is_lost_at_each_exchange
supply rail out of tolerance, tripped, in current limit or off
    run/test_power.py test_a_rail_that_is_not_as_it_should_be_stops_the_run_and_switches_the_block_off
    run/test_power.py test_a_rail_that_goes_while_the_meters_sample_is_seen_before_the_reading_is_believed
    run/test_watched_questions.py test_a_rail_that_goes_while_a_question_stands_stops_the_run_and_is_told_at_once
    run/test_watched_questions.py test_an_answer_that_is_typed_while_a_look_is_under_way_counts
instrument refuses or ignores a command that makes it safe
    run/test_power.py test_a_supply_that_does_not_obey_on_the_way_out_is_told
    conformance/test_making_safe.py test_each_command_that_makes_safe_fails_in_turn
block off while a run was stopped
    run/test_power.py test_a_run_that_goes_on_with_the_block_off_meanwhile_warms_it_up_as_another_visit
    run/test_power.py test_the_least_time_off_is_kept_when_a_run_goes_on
another instrument at an address during a run
    drivers/test_scpi_voltmeter.py test_another_meter_of_the_same_model_is_refused_over_a_new_connection
    drivers/wire/test_visa.py test_an_instrument_exchanged_between_two_connections_is_refused
chamber in standby while a run was stopped, or opened for `:remount`
    run/test_way_out.py test_a_run_resumed_at_a_temperature_lets_the_block_soak_again
    run/test_way_out.py test_a_block_mounted_again_at_a_temperature_soaks_again
instruments absent at start or resume
    run/test_runner.py test_every_absent_instrument_is_named_at_once
    run/test_way_out.py test_instruments_that_were_opened_before_one_failed_are_let_go
    run/test_runner.py test_resumed_with_the_instruments_still_off_a_run_stays_as_it_was
    run/test_disturbed_runs.py test_no_record_is_lost_whatever_is_done
power cut of the computer, SIGKILL
    run/test_runner.py test_stopped_at_the_task_to_mount_it_asks_for_that_mounting_and_not_for_the_one_before
    run/test_signals.py test_hit_by_a_signal_killed_and_resumed_it_ends_as_if_nothing_had_been
    cli/test_answers.py test_answers_from_two_places_and_a_kill_change_nothing
Ctrl-C once, closed terminal (SIGHUP), SIGTERM
    run/test_disturbed_runs.py test_the_bench_is_left_safe_at_every_signal
    run/test_way_out.py test_a_terminal_that_cannot_be_written_to_any_more_stops_no_run
    run/test_signals.py test_hit_by_a_signal_killed_and_resumed_it_ends_as_if_nothing_had_been
    run/test_left_safe.py test_every_way_out_leaves_the_bench_safe
Ctrl-C again, while the run closes the bench
    run/test_way_out.py test_signals_on_the_way_out_cancel_nothing_and_hide_no_cause
    drivers/wire/test_haste.py test_in_haste_a_wait_that_is_under_way_is_cut_short
Ctrl-C, SIGTERM, SIGHUP or SIGKILL after the last reading
    cli/test_results_made.py test_resume_makes_the_results_that_a_run_lacks_and_no_others
    run/test_signals.py test_when_the_bench_is_safe_a_second_signal_ends_the_program_at_once
    cli/test_program.py test_no_signal_takes_the_place_of_a_refusal_on_its_way
    cli/test_results_made.py test_killed_between_two_results_it_lacks_the_others
request to stop (`bench control RUN stop`, panel, `:stop`)
    run/test_living_runs.py test_stop_is_heard_in_the_middle_of_a_movement
    run/test_asking.py test_a_wish_to_stop_leaves_a_question_as_ctrl_c_does
second, late or unsuitable answer
    run/test_asking.py test_the_first_answer_counts_and_the_other_place_says_so
    run/test_asking.py test_what_is_stale_double_ill_fitting_or_garbage_is_refused_on_record_and_the_question_stands
no program reads the output (closed pipe), or no standard output
    cli/test_program.py test_a_run_whose_output_nobody_reads_any_more_goes_on_to_its_verdict
    cli/test_program.py test_without_a_standard_output_a_command_ends_with_its_status
suspended laptop, or computer's clock set by somebody
    run/test_watches.py test_a_jump_is_told_once_and_every_reading_is_taken
    run/test_watches.py test_a_clock_that_is_set_by_little_is_none
full disk
    run/test_runner.py test_a_full_disk_stops_the_run_with_the_bench_closed
    run/test_record.py test_a_disk_that_takes_nothing_more_loses_nothing_and_says_so
second program on the bench
    drivers/wire/test_holding.py test_who_holds_it_is_named_and_what_a_killed_program_held_is_free
    cli/test_instruments.py test_instruments_that_another_program_holds_are_refused_with_its_name
chamber that does not move (its temperature does not change)
    run/test_watches.py test_a_chamber_short_of_a_fifth_of_its_way_is_told_of_once_and_the_run_goes_on
head that moves away from its target, or is outside its limits
    conformance/test_every_head.py test_a_head_that_turns_away_from_where_it_is_sent_is_stopped_within_two_samples
    conformance/test_every_head.py test_a_head_that_leaves_its_limits_is_stopped_at_once
head that stalls
    drivers/test_motion.py test_a_head_that_stands_short_of_its_target_has_stalled_after_five_seconds
    conformance/test_every_head.py test_a_head_that_is_stuck_has_not_arrived_and_is_stopped
"""
"""Each row of the table, and below it its tests: a file below `tests`, and a function in it."""
HELD_BY = {
    row: [one.split() for one in tests]
    for row, *tests in (part.split("\n    ") for part in re.split(r"\n(?! )", HELD.strip()))
}


def names_in(path):
    return {
        node.name for node in ast.parse((ROOT / "tests" / path).read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }  # fmt: skip


@pytest.mark.parametrize("row", EVENTS, ids=[row[0] for row in EVENTS])
def test_a_row_is_whole_and_its_tests_exist(row):
    assert len(row) == 4
    assert all(row)
    named = HELD_BY[row[0]]
    assert named
    assert [(path, name) for path, name in named if name not in names_in(path)] == []


def test_no_tests_are_named_for_a_row_that_is_gone():
    assert HELD_BY.keys() == {row[0] for row in EVENTS}


def test_the_events_that_matter_are_in_the_table():
    assert [words for words in WANTED if not any(words in row[0] for row in EVENTS)] == []
