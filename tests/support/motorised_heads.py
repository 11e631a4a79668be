"""Motorised heads in driver tests: their travel, and a head opened on its served simulation."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from drivers.motion import Travel
from sim.wires.session import Dialect
from sim.world.world import World
from tests.support.simulated_stand import served

DEG = math.pi / 180


def travel(tolerance_rad: float, speed_rad_s: float = 10 * DEG, settle_s: float = 0.5) -> Travel:
    """Return a `Travel` from -10° to 370°."""
    return Travel(-10 * DEG, 370 * DEG, tolerance_rad, speed_rad_s, settle_s=settle_s)


@contextmanager
def opened(
    dialect: Dialect, make: Callable[..., Any], world: World, facts: ModuleType, **wire: Any
) -> Iterator[Any]:
    """Serve a simulated head; yield its opened driver, which `make(session, clock)` returns, and close it."""
    ends = {"read_termination": facts.READ_TERMINATION, "write_termination": facts.WRITE_TERMINATION}
    with served(dialect, "head", world, **ends, **wire) as session:
        head = make(session, world.clock)
        head.open()
        try:
            yield head
        finally:
            head.close()
