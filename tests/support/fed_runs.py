"""A supply in memory for a block that is fed, and runners that use it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from bench.config.bench_file.stand import UnitSupplySection
from bench.config.procedure.plan import Plan
from bench.run.power import Feeding
from bench.run.record import Record
from bench.run.runner import Runner
from drivers.interfaces import (
    Identity,
    InstrumentRefused,
    OutputLimits,
    OutputSettings,
    OutputState,
    SetOtherwise,
    SupplyLimits,
)
from sim.world.clock import VirtualClock
from tests.support.fed_bench import FEED
from tests.support.runner_bench import PLAN, Bench, Person, instruments, runner_of

LIMITS = SupplyLimits(
    {
        "P25V": OutputLimits((0.0, 25.0), (0.0, 1.0), 0.001, 0.001),
        "N25V": OutputLimits((-25.0, 0.0), (0.0, 1.0), 0.001, 0.001),
    }
)
AS_NEW = OutputState(False, OutputSettings(0.0, 1.0), 0.0, 0.0)


class Supply:
    """A supply that lists its switching in `done`; `at[n]` changes its outputs' states at the n-th query."""

    name = "power_supply"
    asks_person = False

    def __init__(
        self,
        clock: VirtualClock,
        found: Mapping[str, OutputState] | None = None,
        at: Mapping[int, Callable[["Supply"], None]] | None = None,
    ) -> None:
        self.clock = clock
        self.outputs: tuple[str, ...] = ("P25V", "N25V")
        self.states = dict(found or dict.fromkeys(self.outputs, AS_NEW))
        self.at = dict(at or {})
        self.looks = 0
        self.done: list[tuple[float, str, bool]] = []
        self.stuck = False

    def open(self) -> Identity:
        return Identity("maker", "supply")

    def close(self) -> None:
        pass

    def state(self, key: str) -> dict[str, OutputState]:
        self.looks += 1
        if self.looks in self.at:
            self.at[self.looks](self)
        return dict(self.states)

    def set_up(self, settings: Mapping[str, OutputSettings], key: str) -> None:
        for output, wanted in settings.items():
            if self.states[output].on and self.states[output].settings != wanted:
                raise SetOtherwise(self.name, f"its output {output} is on and set otherwise", "switch it off")
        for output, wanted in settings.items():
            self.states[output] = replace(self.states[output], settings=wanted)

    def switch(self, output: str, on: bool, key: str) -> None:
        if self.stuck:
            raise InstrumentRefused(self.name, "it does not obey", "look at it")
        self.done.append((self.clock.now_s(), output, on))
        given_v = self.states[output].settings.voltage_v
        self.states[output] = replace(
            self.states[output], on=on, voltage_v=given_v if on else 0.0, current_a=0.05 if on else 0.0
        )

    def switch_all_off(self) -> str:
        for output in self.outputs:
            self.switch(output, False, "all")
        return ""

    def befall(self, output: str, **changes: Any) -> None:
        """Change the state of an output."""
        self.states[output] = replace(self.states[output], **changes)

    @property
    def is_on(self) -> bool:
        return any(state.on for state in self.states.values())


def found_on() -> dict[str, OutputState]:
    """Return outputs that are on, with the settings of the bench file."""
    return {rail.output: OutputState(True, rail.settings, rail.voltage, 0.05) for rail in section_of().rails}


def section_of(**changes: Any) -> UnitSupplySection:
    """Return the section `FEED` of the block's supply, with changes."""
    return UnitSupplySection.model_validate({**FEED, **changes})


def fed_runner(
    bench: Bench, record: Record, supply: Supply, plan: Plan = PLAN, person: Any = None, **options: Any
) -> Runner:
    """Return a runner over a bench whose block is fed; the option `feed` changes members of `FEED`."""
    feed = options.pop("feed", {})
    having = replace(instruments(bench), power_supply=supply)
    options["feeding"] = Feeding(section_of(**feed), LIMITS)
    return runner_of(plan, having, person or Person(bench), supply.clock, record, **options)
