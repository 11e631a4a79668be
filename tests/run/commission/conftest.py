"""What the checks of an evening are given: a clock whose time passes at once, and a person who answers."""

import pytest

from sim.world.clock import VirtualClock
from tests.support.commission_bench import Says


@pytest.fixture
def clock() -> VirtualClock:
    """A clock that waits for nothing."""
    return VirtualClock()


@pytest.fixture
def person() -> Says:
    """An operator."""
    return Says()
