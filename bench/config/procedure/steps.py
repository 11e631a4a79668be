"""The steps of a plan: frozen records of single actions. None of them touches an instrument by itself.

Every step has a `key` that is unique in its plan and the same in each expansion of the procedure, such as
"0012/read/1.2.5": the number of the step in the plan (from 1), its kind, and installation.pass.point.
Readings of series 2 of an installation (a later mounting, temperature or switch-on) have keys such as
"1s2.2.5". Readings of the shorted and of the reference input have the labels S and R in place of an
installation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, Protocol, TypeVar

from bench.base.arrays import ARCSEC
from bench.base.languages import message
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
"""The reason stated for a wait between a turn and its reading."""

_UNITS: Final[Mapping[Settled, str]] = {"signals": "V", "temperature": "K"}
_INPUTS: Final = {SHORTED: message("the shorted input"), REFERENCE: message("the reference input")}


@dataclass(frozen=True, slots=True)
class OnFailure:
    """The handling of a failed step: up to `repeats` repeats; then the run stops, or continues without a result."""

    repeats: int = 1
    then: Literal["stop", "continue"] = "stop"


@dataclass(frozen=True, slots=True)
class OperatorTime:
    """The operator's expected times, s: for a turn, a mounting, an answer or small task, an input change."""

    turn_s: float = 120.0
    mount_s: float = 1200.0
    answer_s: float = 30.0
    input_s: float = 60.0


@dataclass(frozen=True)
class Times:
    """The quantities that determine the duration of a step: operator times, mains frequency, block supply."""

    operator: OperatorTime
    line_hz: float = 50.0
    supply: UnitSupplySection | None = None


class AtBench(Protocol):
    """The bench on which a step is carried out."""

    instruments: Any
    person: Person
    clock: Clock

    @property
    def between_naps(self) -> Callable[[], None]:
        """A function that carries out the operator's commands; a step calls it repeatedly while it waits."""
        ...

    def watch_rails(self, key: str) -> None:
        """Check the rails of the block's supply when the check is due; `key` is the current step."""
        ...


class ActionVerb(FileModel):
    """A verb of a procedure file that contains no other steps.

    It is allowed anywhere, except `power` and `temperature` inside `input`.
    """

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the steps of the verb; `key("wait")` returns the key of the next step, of kind "wait"."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Step:
    """A step of a plan; each kind of step is a subclass.

    `NAME` is the kind in counts and in JSON; `BY_OPERATOR` says whether the step needs the operator on a bench
    without motors. A kind in a separate module has a `VERB`, which is called `NAME` in procedure files. `BRINGS` is
    the dataclass of the step's result; the fields of the result are recorded.
    """

    NAME: ClassVar[str] = ""
    BY_OPERATOR: ClassVar[bool] = False
    VERB: ClassVar[type[ActionVerb] | None] = None
    BRINGS: ClassVar[Any] = None

    key: str

    def describe(self) -> str:
        """Return a one-line description of the action."""
        raise NotImplementedError

    def takes_s(self, times: Times) -> float:
        """Return the expected duration, s; for settling, the shortest possible."""
        raise NotImplementedError

    def carry_out(self, at: AtBench) -> Any:
        """Carry the step out on a bench; return its result, or None. Raises `BenchError`.

        The default calls the bench's method for the kind, such as `do_turn` for the kind "turn".
        """
        return getattr(at, f"do_{self.NAME}")(self)


@dataclass(frozen=True, slots=True)
class Mount(Step):
    """The operator mounts the block in an installation; `series` counts the visits to it."""

    NAME: ClassVar[str] = "mount"
    BY_OPERATOR: ClassVar[bool] = True

    installation: str
    series: int

    def describe(self) -> str:
        return message(f"mount the block in installation {mount_in_words(self.installation, self.series)}")

    def takes_s(self, times: Times) -> float:
        return times.operator.mount_s


@dataclass(frozen=True, slots=True)
class _AtPoint(Step):
    """A step at a numbered point of a pass; `series` numbers the visits to the installation."""

    installation: str
    series: int
    pass_number: int
    point: int

    def place(self) -> str:
        """Return the installation or the input in words: "installation 1", "the shorted input (series 2)"."""
        if self.installation in _INPUTS:
            return mount_in_words(_INPUTS[self.installation], self.series)
        return message(f"installation {mount_in_words(self.installation, self.series)}")

    def where(self) -> str:
        number, point = self.pass_number, self.point
        visit = "" if self.series == 1 else message(f" (series {self.series})")
        if self.installation == SHORTED:
            return message(f"the shorted input{visit}, pass {number}, point {point}")
        if self.installation == REFERENCE:
            return message(f"the reference input{visit}, pass {number}, point {point}")
        mount = mount_in_words(self.installation, self.series)
        return message(f"installation {mount}, pass {number}, point {point}")


@dataclass(frozen=True, slots=True)
class Turn(_AtPoint):
    """The head turns to an angle and arrives there with rising (+1) or falling (-1) angle."""

    NAME: ClassVar[str] = "turn"
    BY_OPERATOR: ClassVar[bool] = True

    target_rad: float
    direction: Direction
    on_failure: OnFailure = OnFailure()

    def describe(self) -> str:
        return message(
            f"turn the head to {degrees(self.target_rad)}, {APPROACH[self.direction]}, for {self.where()}"
        )

    def takes_s(self, times: Times) -> float:
        return times.operator.turn_s


@dataclass(frozen=True, slots=True)
class Wait(Step):
    """The run waits for a fixed duration of bench time."""

    NAME: ClassVar[str] = "wait"

    duration_s: float
    reason: str

    def describe(self) -> str:
        return message(f"wait {duration(self.duration_s)}: {self.reason}")

    def takes_s(self, times: Times) -> float:
        return self.duration_s


@dataclass(frozen=True, slots=True)
class Settle(Step):
    """The run waits until the signals or the temperature have settled; it fails after `timeout_s`.

    A sample is taken every `interval_s`. The quantity has settled when the samples cover the last `window_s` and
    span no more than `precision` (V for signals, K for temperature).
    """

    NAME: ClassVar[str] = "settle"

    what: Settled
    precision: float
    window_s: float
    timeout_s: float
    interval_s: float

    def describe(self) -> str:
        whose = message("signals stay") if self.what == "signals" else message("temperature stays")
        return message(
            f"wait until the {whose} within {precision_in_words(self)} for {duration(self.window_s)}, "
            f"at most {duration(self.timeout_s)}"
        )

    def takes_s(self, times: Times) -> float:
        return min(self.window_s + self.interval_s, self.timeout_s)


@dataclass(frozen=True, slots=True)
class SelectInput(Step):
    """The operator switches all three voltmeter inputs; a reference input has the voltage `reference_v`."""

    NAME: ClassVar[str] = "input"
    BY_OPERATOR: ClassVar[bool] = True

    source: InputSource
    reference_v: float | None = None

    def describe(self) -> str:
        match self.source:
            case "short":
                return message("short the three inputs")
            case "reference":
                return message(f"switch the three inputs to the reference of {self.reference_v:g} V")
            case "signal":
                return message("switch the three inputs back to the signals")

    def takes_s(self, times: Times) -> float:
        return times.operator.input_s


@dataclass(frozen=True, slots=True)
class Read(_AtPoint):
    """The voltmeters take one reading: `samples` samples of `nplc` power-line cycles each.

    A reading of the shorted or the reference input (installation S or R) has no target and no direction. `scan` is
    the order in which the channels are read, such as "zyx"; if empty, the order in the bench file.
    """

    NAME: ClassVar[str] = "read"

    target_rad: float | None
    direction: Direction | None
    samples: int
    nplc: float
    on_failure: OnFailure = OnFailure()
    scan: str = ""

    def describe(self) -> str:
        where = self.where()
        if self.target_rad is not None:
            where = message(f"{where} at {degrees(self.target_rad)}")
        return message(
            f"read {where}: {self.samples} samples of {self.nplc:g} power-line cycles{scan_in_words(self)}"
        )

    def takes_s(self, times: Times) -> float:
        # with autozero, a sample takes two integrations
        return self.samples * (2.0 * self.nplc / times.line_hz + _SAMPLE_OVERHEAD_S)


@dataclass(frozen=True, slots=True)
class Ask(Step):
    """The operator answers a question; the step has the fields of `drivers.person.Prompt`."""

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
        default = "" if self.default is None else f" [{self.default}]"
        return message(f"ask: {self.text}{default}")

    def takes_s(self, times: Times) -> float:
        return times.operator.answer_s


@dataclass(frozen=True, slots=True)
class SetTemperature(Step):
    """The chamber is set to a temperature; the soak is a separate `Wait`."""

    NAME: ClassVar[str] = "temperature"
    BY_OPERATOR: ClassVar[bool] = True

    target_c: float

    def describe(self) -> str:
        return message(f"set the chamber to {self.target_c:g} °C")

    def takes_s(self, times: Times) -> float:
        return times.operator.answer_s


@dataclass(frozen=True, slots=True)
class Power(Step):
    """The block is switched on, off, or off and on again ("cycle"), by its supply in the bench file.

    In a cycle it stays off for at least `off_s`. Once on, it warms up for `warm_up_s`; None means as stated in the
    bench file.
    """

    NAME: ClassVar[str] = "power"

    switch: Switching
    off_s: float = 0.0
    warm_up_s: float | None = None

    def describe(self) -> str:
        if self.switch == "off":
            return message("switch the block off")
        off = message(f" off for {duration(self.off_s)} and") if self.off_s else message(" off and")
        warm = (
            message("let it warm up")
            if self.warm_up_s is None
            else message(f"let it warm up for {duration(self.warm_up_s)}")
        )
        again = (
            message(f"switch the block{off} on again")
            if self.switch == "cycle"
            else message("switch the block on")
        )
        return message(f"{again}, {warm if self.warm_up_s != 0.0 else message('without warm-up')}")

    def takes_s(self, times: Times) -> float:
        return power_duration_s(self, times.supply)


@dataclass(frozen=True, slots=True)
class Level(Step):
    """The level on the platform is read with the head at 0°, in two positions half a turn apart.

    The head is set to 0° `settings` times. With `within_rad`, the platform is levelled until its tilt is at
    most `within_rad`, before the block is mounted in `installation`. Without it, the tilt is only read;
    `installation` and `series` are then those for which the platform was last levelled.
    """

    NAME: ClassVar[str] = "level"
    BY_OPERATOR: ClassVar[bool] = True

    installation: str
    series: int
    settings: int = 1
    within_rad: float | None = None

    def describe(self) -> str:
        where = message(f"installation {mount_in_words(self.installation, self.series)}")
        if self.within_rad is None:
            what = message(f"read the level as the platform stands, levelled for {where}")
        else:
            what = message(f"level the platform to {self.within_rad / ARCSEC:g}″ for {where}, read the level")
        times = "" if self.settings == 1 else message(f", {self.settings} settings of the head")
        return message(f"{what} in two positions{times}")

    def takes_s(self, times: Times) -> float:
        # turns, readings (two positions, two axes) and levelling
        by_hand = times.operator
        levelled_s = by_hand.mount_s * (self.within_rad is not None)
        return self.settings * (by_hand.turn_s + 4.0 * by_hand.answer_s) + levelled_s


# --- the order of the channels ----------------------------------------------------------------------


class _HasChannels(Protocol):
    @property
    def channels(self) -> tuple[Channel, ...]: ...


_Meter = TypeVar("_Meter", bound=_HasChannels)


def in_scan_order(meters: Sequence[_Meter], scan: str) -> list[_Meter]:
    """Return the meters in the order in which a scan such as "zyx" starts them; unchanged for an empty scan.

    A meter with several channels is placed by its first channel; the order of its channels is fixed.
    """
    return sorted(meters, key=lambda meter: scan.find(meter.channels[0])) if scan else list(meters)


def read_order(meters: Sequence[_HasChannels]) -> str:
    """Return the order, such as "xyz", in which the channels are read if the meters start in the order given."""
    return "".join(channel for meter in meters for channel in meter.channels)


# --- in words ---------------------------------------------------------------------------------------


def mount_in_words(installation: str, series: int) -> str:
    """Return an installation in words: "1", or "1 (series 2)" on a later visit."""
    return installation if series == 1 else message(f"{installation} (series {series})")


def precision_in_words(step: Settle) -> str:
    """Return the precision of a settling step with its unit, such as "50 µV" or "0.1 K"."""
    if step.what == "signals" and step.precision < 0.01:
        size, unit = (1e-6, "µV") if step.precision < 1e-3 else (1e-3, "mV")
        return f"{step.precision / size:g} {unit}"
    return f"{step.precision:g} {_UNITS[step.what]}"


def scan_in_words(step: Read) -> str:
    """Return the clause on the scan order, such as ", the channels in the order z, y, x"; "" without one."""
    return message(f", the channels in the order {', '.join(step.scan)}") if step.scan else ""


# --- durations --------------------------------------------------------------------------------------


def power_duration_s(step: Power, supply: UnitSupplySection | None) -> float:
    """Return the duration of a power step, s: time off, switching and shortest warm-up.

    Times that neither the step nor `supply` states count as zero.
    """
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
