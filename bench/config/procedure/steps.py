"""The steps of a plan: what each does, frozen, and how it is told. None of them touches an instrument.

Every step has a `key`, unique in its plan and the same each time the procedure is expanded, such as
"0012/read/1.2.5": place in the plan (from 1), kind, installation.pass.point (a series other than the
first follows the installation: "1s2.2.5"). Readings of the shorted and of the reference input are keyed by
their labels S and R in place of an installation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, Protocol, TypeVar

from bench.base.arrays import ARCSEC
from bench.base.text import APPROACH, degrees, duration
from bench.base.yaml_files import FileModel
from bench.config.bench_file.stand import UnitSupplySection
from bench.readings.table import REFERENCE, SHORTED
from drivers.clock import Clock
from drivers.interfaces import Channel, Direction
from drivers.person import Person, PromptKind

Settled = Literal["signals", "temperature"]
InputSource = Literal["signal", "short", "reference"]
Switching = Literal["on", "off", "cycle"]

_SAMPLE_OVERHEAD_S: Final = 0.01

SETTLING: Final = "settling"
"""The reason of a wait between a turn and its reading."""

_UNITS: Final[Mapping[Settled, str]] = {"signals": "V", "temperature": "K"}
_INPUTS: Final = {SHORTED: "the shorted input", REFERENCE: "the reference input"}


@dataclass(frozen=True, slots=True)
class OnFailure:
    """What becomes of a step that fails: so many repeats, then the run stops or goes on without its result."""

    repeats: int = 1
    then: Literal["stop", "continue"] = "stop"


@dataclass(frozen=True, slots=True)
class OperatorTime:
    """How long the operator is expected to take: a turn, a mounting, switching the inputs, any other task, s."""

    turn_s: float = 120.0
    mount_s: float = 1200.0
    answer_s: float = 30.0
    input_s: float = 60.0


@dataclass(frozen=True)
class Times:
    """What the time of a step depends on: the operator, the mains, the supply of the block."""

    operator: OperatorTime
    line_hz: float = 50.0
    supply: UnitSupplySection | None = None


class AtBench(Protocol):
    """The bench on which a step carries itself out; `between_naps` hears wishes meanwhile."""

    instruments: Any
    person: Person
    clock: Clock

    @property
    def between_naps(self) -> Callable[[], None]:
        """What hears wishes, called while a step waits."""
        ...

    def watch_rails(self, key: str) -> None:
        """Look at the rails of the block's supply when it is time to."""
        ...


class ActionVerb(FileModel):
    """A verb of a procedure file that holds no steps and stands anywhere outside an input."""

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the steps that the verb stands for; `key("wait")` gives the next step its key."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Step:
    """A step of a plan; a kind of step is a class.

    `NAME` is the kind in counts and in JSON. A kind in a module of its own has a `VERB`, which procedure files know
    as `NAME`. It brings an instance of `BRINGS`, a dataclass, whose fields are recorded.
    """

    NAME: ClassVar[str] = ""
    BY_OPERATOR: ClassVar[bool] = False
    VERB: ClassVar[type[ActionVerb] | None] = None
    BRINGS: ClassVar[Any] = None

    key: str

    def describe(self) -> str:
        """Say in one line what is done."""
        raise NotImplementedError

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s; of settling, the shortest that it can take."""
        raise NotImplementedError

    def carry_out(self, at: AtBench) -> Any:
        """Carry the step out on a bench; return what it brings, None for nothing. Raises `BenchError`.

        A kind that needs the state of the bench has a method there: `do_turn` for the kind "turn".
        """
        return getattr(at, f"do_{self.NAME}")(self)


@dataclass(frozen=True, slots=True)
class Mount(Step):
    """The operator mounts the block in an installation; `series` numbers the visits to it."""

    NAME: ClassVar[str] = "mount"
    BY_OPERATOR: ClassVar[bool] = True

    installation: str
    series: int

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"mount the block in installation {mount_in_words(self.installation, self.series)}"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return times.operator.mount_s


@dataclass(frozen=True, slots=True)
class _AtPoint(Step):
    """A step at a point: in which installation, on which visit to it, in which pass."""

    installation: str
    series: int
    pass_number: int
    point: int

    def place(self) -> str:
        """Say what is turned or read: "installation 1", "the shorted input", with a further series."""
        if self.installation in _INPUTS:
            return _INPUTS[self.installation] + ("" if self.series == 1 else f" (series {self.series})")
        return f"installation {mount_in_words(self.installation, self.series)}"

    def where(self) -> str:
        """Say in words at which point of which pass it is."""
        return f"{self.place()}, pass {self.pass_number}, point {self.point}"


@dataclass(frozen=True, slots=True)
class Turn(_AtPoint):
    """The head is turned to an angle, arriving with rising (+1) or falling (-1) angle."""

    NAME: ClassVar[str] = "turn"
    BY_OPERATOR: ClassVar[bool] = True

    target_rad: float
    direction: Direction
    on_failure: OnFailure = OnFailure()

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"turn the head to {degrees(self.target_rad)}, {APPROACH[self.direction]}, for {self.where()}"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return times.operator.turn_s


@dataclass(frozen=True, slots=True)
class Wait(Step):
    """Bench time passes."""

    NAME: ClassVar[str] = "wait"

    duration_s: float
    reason: str

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"wait {duration(self.duration_s)}: {self.reason}"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return self.duration_s


@dataclass(frozen=True, slots=True)
class Settle(Step):
    """The bench waits until what it watches has settled; one that has not after `timeout_s` is a failure.

    Settled: every sample of the last `window_s` lies within `precision` (V or K, by `what`) and one sample is
    older than the window. A sample is taken each `interval_s`.
    """

    NAME: ClassVar[str] = "settle"

    what: Settled
    precision: float
    window_s: float
    timeout_s: float
    interval_s: float

    def describe(self) -> str:
        """Say in one line what is done."""
        whose = "signals stay" if self.what == "signals" else "temperature stays"
        return (
            f"wait until the {whose} within {precision_in_words(self)} for {duration(self.window_s)}, "
            f"at most {duration(self.timeout_s)}"
        )

    def takes_s(self, times: Times) -> float:
        """Return the shortest time that it can take, s."""
        return min(self.window_s + self.interval_s, self.timeout_s)


@dataclass(frozen=True, slots=True)
class SelectInput(Step):
    """The operator switches all three inputs of the voltmeters; `reference_v` is given for a reference."""

    NAME: ClassVar[str] = "input"
    BY_OPERATOR: ClassVar[bool] = True

    source: InputSource
    reference_v: float | None = None

    def describe(self) -> str:
        """Say in one line what is done."""
        match self.source:
            case "short":
                return "short the three inputs"
            case "reference":
                return f"switch the three inputs to the reference of {self.reference_v:g} V"
            case "signal":
                return "switch the three inputs back to the signals"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return times.operator.input_s


@dataclass(frozen=True, slots=True)
class Read(_AtPoint):
    """The voltmeters take one reading: `samples` samples of `nplc` power-line cycles each.

    A reading of the shorted or reference input (installation S, R) has neither target nor direction. `scan` is
    the order in which the channels are read, such as "zyx"; empty for that of the bench file.
    """

    NAME: ClassVar[str] = "read"

    target_rad: float | None
    direction: Direction | None
    samples: int
    nplc: float
    on_failure: OnFailure = OnFailure()
    scan: str = ""

    def describe(self) -> str:
        """Say in one line what is done."""
        where = "" if self.target_rad is None else f" at {degrees(self.target_rad)}"
        return (
            f"read {self.where()}{where}: {self.samples} samples of {self.nplc:g} power-line cycles"
            f"{scan_in_words(self)}"
        )

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s. Autozero makes a sample two integrations long."""
        return self.samples * (2.0 * self.nplc / times.line_hz + _SAMPLE_OVERHEAD_S)


@dataclass(frozen=True, slots=True)
class Ask(Step):
    """The operator answers a question; the fields are those of `drivers.interfaces.Prompt`."""

    NAME: ClassVar[str] = "ask"
    BY_OPERATOR: ClassVar[bool] = True

    kind: PromptKind
    text: str
    default: str | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None

    def describe(self) -> str:
        """Say in one line what is done."""
        default = "" if self.default is None else f" [{self.default}]"
        return f"ask: {self.text}{default}"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return times.operator.answer_s


@dataclass(frozen=True, slots=True)
class SetTemperature(Step):
    """The chamber is set to a temperature; the soak is a `Wait` of its own."""

    NAME: ClassVar[str] = "temperature"
    BY_OPERATOR: ClassVar[bool] = True

    target_c: float

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"set the chamber to {self.target_c:g} °C"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return times.operator.answer_s


@dataclass(frozen=True, slots=True)
class Power(Step):
    """The block is switched on, off, or off and on again (a cycle), as the bench file says of its supply.

    In a cycle it is off for `off_s` at least. Once on it warms up for `warm_up_s`, as the bench file says for None.
    """

    NAME: ClassVar[str] = "power"

    switch: Switching
    off_s: float = 0.0
    warm_up_s: float | None = None

    def describe(self) -> str:
        """Say in one line what is done."""
        if self.switch == "off":
            return "switch the block off"
        off = f" off for {duration(self.off_s)} and" if self.off_s else " off and"
        warm = (
            "let it warm up" if self.warm_up_s is None else f"let it warm up for {duration(self.warm_up_s)}"
        )
        again = f"switch the block{off} on again" if self.switch == "cycle" else "switch the block on"
        return f"{again}, {warm if self.warm_up_s != 0.0 else 'without warm-up'}"

    def takes_s(self, times: Times) -> float:
        """Return the expected time, s."""
        return power_duration_s(self, times.supply)


@dataclass(frozen=True, slots=True)
class Level(Step):
    """The level on the platform is read with the head at 0°, in two positions for each of so many `settings` of it.

    With `within_rad` the platform is levelled first, and again where it is further off: for the mounting that
    follows. Without it stands as it is found, for the mounting that it was levelled for.
    """

    NAME: ClassVar[str] = "level"
    BY_OPERATOR: ClassVar[bool] = True

    installation: str
    series: int
    settings: int = 1
    within_rad: float | None = None

    def describe(self) -> str:
        """Say in one line what is done."""
        where = f"installation {mount_in_words(self.installation, self.series)}"
        if self.within_rad is None:
            what = f"read the level as the platform stands, levelled for {where}"
        else:
            what = f"level the platform to {self.within_rad / ARCSEC:g}″ for {where}, read the level"
        times = "" if self.settings == 1 else f", {self.settings} settings of the head"
        return f"{what} in two positions{times}"

    def takes_s(self, times: Times) -> float:
        """Return the expected time of turns, two readings of two axes and levelling, s."""
        by_hand = times.operator
        levelled_s = by_hand.mount_s * (self.within_rad is not None)
        return self.settings * (by_hand.turn_s + 4.0 * by_hand.answer_s) + levelled_s


# --- the order of the channels ----------------------------------------------------------------------


class _HasChannels(Protocol):
    @property
    def channels(self) -> tuple[Channel, ...]: ...


_Meter = TypeVar("_Meter", bound=_HasChannels)


def in_scan_order(meters: Sequence[_Meter], scan: str) -> list[_Meter]:
    """Return the meters in the order in which they are triggered for a scan such as "zyx"; as listed for none.

    A meter of several channels stands where its first one does; among its own it keeps its own order.
    """
    return sorted(meters, key=lambda meter: scan.find(meter.channels[0])) if scan else list(meters)


def read_order(meters: Sequence[_HasChannels]) -> str:
    """Return the order in which meters read the channels that are triggered one after the other: "xyz"."""
    return "".join(channel for meter in meters for channel in meter.channels)


# --- in words ---------------------------------------------------------------------------------------


def mount_in_words(installation: str, series: int) -> str:
    """Return an installation as it is told: "1", on a later visit "1 (series 2)"."""
    return installation if series == 1 else f"{installation} (series {series})"


def precision_in_words(step: Settle) -> str:
    """Return the precision of a settling with its unit: "50 µV", "0.1 K"."""
    if step.what == "signals" and step.precision < 0.01:
        size, unit = (1e-6, "µV") if step.precision < 1e-3 else (1e-3, "mV")
        return f"{step.precision / size:g} {unit}"
    return f"{step.precision:g} {_UNITS[step.what]}"


def scan_in_words(step: Read) -> str:
    """Return in which order the channels are read, to be told after the rest; empty where nothing is said."""
    return f", the channels in the order {', '.join(step.scan)}" if step.scan else ""


# --- how long ---------------------------------------------------------------------------------------


def power_duration_s(step: Power, supply: UnitSupplySection | None) -> float:
    """Return how long switching takes, s, with the time off and the shortest warm-up, as far as both are stated."""
    least_off_s, switching_s, warm_up_s = (
        (0.0, 0.0, 0.0) if supply is None else (supply.least_off, supply.switching_s, supply.warm_up_s)
    )
    warm_up_s = warm_up_s if step.warm_up_s is None else step.warm_up_s
    match step.switch:
        case "on":
            return least_off_s + switching_s + warm_up_s
        case "off":
            return switching_s
        case "cycle":
            return max(step.off_s, least_off_s) + 2.0 * switching_s + warm_up_s
