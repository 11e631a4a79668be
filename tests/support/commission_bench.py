"""A commissioning session ("evening") with instruments in memory, a virtual clock and a scripted person."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.shipped import find_bench
from bench.run.commission.session import CommissioningPerson, CommissioningSession, WireWatch
from bench.run.instruments import Instruments
from drivers.interfaces import (
    BenchError,
    Channel,
    Direction,
    HeadPosition,
    Identity,
    LimitExceeded,
    VoltmeterSettings,
)
from drivers.person import Answer, Prompt
from sim.world.clock import VirtualClock


@dataclass
class Says:
    """A person who gives the `answers` in turn, then always "yes"; an exception among them is raised."""

    answers: list[str | BaseException] = field(default_factory=list)
    asked: list[Prompt] = field(default_factory=list)
    on_prompt: Callable[[Prompt], None] = lambda prompt: None

    def ask(self, prompt: Prompt) -> Answer:
        self.asked.append(prompt)
        self.on_prompt(prompt)
        answer = self.answers.pop(0) if self.answers else "yes"
        if isinstance(answer, BaseException):
            raise answer
        return Answer(prompt.id, answer)


@dataclass
class Meter:
    """A voltmeter that takes `sample_s` per sample, and repeats `samples_v` as often as needed."""

    name: str
    channels: tuple[Channel, ...]
    clock: VirtualClock
    sample_s: float = 0.4
    start_s: float = 0.0
    samples_v: Iterable[float] = (0.0,)
    troubles: list[BaseException | None] = field(default_factory=list)
    closed: int = 0
    settings: VoltmeterSettings | None = None

    def open(self) -> Identity:
        return Identity("Maker", "M1", f"S-{self.name}")

    def close(self) -> None:
        self.closed += 1

    def configure(self, settings: VoltmeterSettings) -> None:
        trouble = self.troubles.pop(0) if self.troubles else None
        if trouble is not None:
            raise trouble
        self.settings = settings

    def reading_time_s(self, settings: VoltmeterSettings, character_time_s: float = 0.0) -> float:
        return settings.samples * 0.41

    def start(self) -> None:
        self.clock.sleep(self.start_s)
        samples = self.settings.samples if self.settings else 0
        self.ready_s = self.clock.now_s() + samples * self.sample_s

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        self.clock.advance_to(self.ready_s)
        given = list(self.samples_v)
        count = self.settings.samples if self.settings else 0
        values = tuple((given * (count // len(given) + 1))[:count])
        return dict.fromkeys(self.channels, values)


@dataclass
class Head:
    """A motorised head at 10 deg/s of the clock; unless it `obeys`, it ignores limits and stops."""

    name: str
    clock: VirtualClock
    limits_rad: tuple[float, float]
    angle_rad: float = 0.0
    obeys: bool = True
    moved: list[tuple[float, Direction]] = field(default_factory=list)
    stops: int = 0
    closed: int = 0
    _goal: tuple[float, float, float] | None = None

    def open(self) -> Identity:
        return Identity("Maker", "H1")

    def close(self) -> None:
        self.closed += 1

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        backed_off = target_rad - direction * 0.017
        low, high = self.limits_rad
        if self.obeys and not (
            low - 1e-9 <= min(target_rad, backed_off) <= max(target_rad, backed_off) <= high + 1e-9
        ):
            raise LimitExceeded(self.name, "outside", "change it")
        self.moved.append((target_rad, direction))
        self.clock.sleep(2.0 + abs(target_rad - self.angle_rad) / 0.1745)
        self.angle_rad = target_rad
        return HeadPosition(target_rad, direction)

    def prepare(self) -> None:
        pass

    def position_rad(self) -> float:
        if self._goal is not None:
            begun_s, start_rad, target_rad = self._goal
            way_rad = min(0.1745 * (self.clock.now_s() - begun_s), abs(target_rad - start_rad))
            self.angle_rad = start_rad + (1 if target_rad > start_rad else -1) * way_rad
        return self.angle_rad

    def start(self, target_rad: float) -> None:
        self._goal = (self.clock.now_s(), self.angle_rad, target_rad)

    def stop(self) -> None:
        self.stops += 1
        if self.obeys:
            self.position_rad()
            self._goal = None


def meters(clock: VirtualClock, **settings: object) -> list[Meter]:
    return [Meter(f"voltmeter.{c}", (c,), clock, **settings) for c in ("x", "y", "z")]  # type: ignore[arg-type]


def motorised() -> BenchFile:
    return load_bench(find_bench("bench-motorised"))


def evening(
    person: Says, clock: VirtualClock, instruments: Instruments, file: BenchFile | None = None
) -> CommissioningSession:
    """Return a commissioning session that measures its durations by the virtual clock."""
    watch = WireWatch(None, clock.now_s)
    return CommissioningSession(
        file or motorised(), instruments, CommissioningPerson(person), clock, clock.now_s, watch, {}
    )


def lost(name: str) -> BenchError:
    from drivers.interfaces import InstrumentLost

    return InstrumentLost(name, "did not answer", "check the cable")


__all__ = ["Head", "Meter", "Says", "evening", "lost", "meters", "motorised", "replace"]
