"""Commands, the panel's buttons, meters that go and kills in any order: a few steps of the campaign."""

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from benchmarks.commands_campaign import Evenings

pytest.importorskip("starlette")
pytestmark = pytest.mark.slow


def test_no_record_is_lost_whatever_is_done():
    """Drawn steps, the same each time."""
    run_state_machine_as_test(
        Evenings,
        settings=settings(
            max_examples=1,
            stateful_step_count=10,
            derandomize=True,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_resumed_with_a_meter_off_and_killed_it_is_brought_to_its_end():
    """What broke records before, step by step: it needs no luck of the draw."""
    evening = Evenings()
    try:
        evening.run("meter off", 12)
        evening.resume(0, "", 0)
        evening.press_resume(0, "", 0)
        evening.switch("voltmeter.y")
        evening.resume(0, "kill", 9)
        evening.press_resume(0, "results", 4)
        evening.bring_to_its_end(0)
    finally:
        evening.teardown()
