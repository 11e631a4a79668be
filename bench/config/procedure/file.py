"""The contents of a procedure file: steps with one verb each, and sections with defaults."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, create_model, field_validator, model_validator

from bench.base.arrays import ARCSEC
from bench.base.languages import message
from bench.base.units import (
    AngleRad,
    DurationS,
    QuantityKind,
    SizeRad,
    SpanS,
    TemperatureC,
    VoltageV,
    above_zero,
    reads,
)
from bench.base.yaml_files import FileModel
from bench.config.bench_file.stand import can_come_about, written_as
from bench.config.procedure.plan import KINDS, OnFailure, OperatorTime
from bench.config.procedure.steps import (
    ActionVerb,
    Ask,
    Power,
    SetTemperature,
    Settle,
    Settled,
    Step,
    Switching,
    Wait,
)
from bench.readings.table import UNORIENTED, scan_order
from drivers.person import PromptKind

Positive = Annotated[int, Field(ge=1)]

TEMPERATURE_DIFFERENCE: Final = QuantityKind(
    message("a difference of temperatures"), "0.1 K", "K", only=("K", "mK")
)


class SettleForm(ActionVerb):
    """Criterion of settling: the samples in a `window` span no more than `precision`.

    A sample is taken every `interval`; settling fails if the criterion is not met by `timeout`.
    """

    precision: float
    window: DurationS
    timeout: DurationS
    interval: DurationS

    @model_validator(mode="after")
    def _can_come_about(self) -> SettleForm:
        can_come_about("precision", self.precision, "the window", self.window, self.interval, self.timeout)
        return self

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the step that waits for settling; the subclass determines which quantity settles."""
        what: Settled = getattr(self, "what")  # noqa: B009 - both kinds have it
        yield Settle(key("settle"), what, self.precision, self.window, self.timeout, self.interval)


class SignalSettle(SettleForm):
    """Settling of the three signals; the precision is in V."""

    what: Literal["signals"] = "signals"
    precision: VoltageV
    interval: DurationS = 1.0


class TemperatureSettle(SettleForm):
    """Settling of the temperature at the block; the precision is in K."""

    what: Literal["temperature"] = "temperature"
    precision: Annotated[float, reads(TEMPERATURE_DIFFERENCE)]
    interval: DurationS = 60.0


def _what_settles(written: Any) -> str:
    what = written.get("what") if isinstance(written, dict) else getattr(written, "what", None)
    return "temperature that settles" if what == "temperature" else "signals that settle"


SettleVerb = Annotated[
    Annotated[SignalSettle, Tag("signals that settle")]
    | Annotated[TemperatureSettle, Tag("temperature that settles")],
    Discriminator(_what_settles),
]


class FailureSection(FileModel):
    """The handling of a failed turn or reading: how often to repeat it, then whether to stop or continue."""

    repeat: Annotated[int, Field(ge=0, le=100)] = 1
    then: Literal["stop", "continue"] = "stop"

    def to_plan(self) -> OnFailure:
        """Return the section in the form used by plans."""
        return OnFailure(self.repeat, self.then)


class ReadingSection(FileModel):
    """The defaults of a reading: samples, power-line cycles, and settling before it.

    `settle` is a fixed time to wait, or a criterion for settled signals.
    """

    samples: Positive = 10
    nplc: Annotated[float, Field(gt=0.0)] = 10.0
    settle: Annotated[
        Annotated[SpanS, Tag("time to settle")] | Annotated[SignalSettle, Tag("settling of signals")],
        written_as(SignalSettle, "settling of signals", "time to settle"),
    ] = 5.0
    on_failure: FailureSection | None = None


class OperatorTimeSection(FileModel):
    """The operator's expected times; they serve only to estimate the duration of a plan."""

    turn: SpanS = 120.0
    mount: SpanS = 1200.0
    answer: SpanS = 30.0
    input: SpanS = 60.0

    def to_plan(self) -> OperatorTime:
        """Return the times in the form used by plans."""
        return OperatorTime(self.turn, self.mount, self.answer, self.input)


Steps = Annotated[tuple["StepEntry", ...], Field(min_length=1)]
DirectionWord = Literal["rising", "falling"]

VERBS: Final = (
    "installation", "repeat", "turn", "read", "input", "wait", "settle", "prompt", "temperature", "temperatures",
    "level", "power", *(kind.NAME for kind in KINDS if kind.VERB is not None), "include",
)  # fmt: skip
_TURN_RAD: Final = math.tau + 1e-9


def _within_a_turn(angle_rad: float) -> float:
    if abs(angle_rad) > _TURN_RAD:
        raise ValueError(f"state an angle within ±360°, not {math.degrees(angle_rad):g}°")
    return angle_rad


def _an_order(text: str) -> str:
    scan_order(text)
    return text.strip().lower()


ScanWord = Annotated[str, AfterValidator(_an_order)]
Angle = Annotated[AngleRad, AfterValidator(_within_a_turn)]


class LevelVerb(FileModel):
    """Read the level on the platform with the head at 0°, in two positions half a turn apart.

    The head is set to 0° `settings` times, as its setting error dominates the uncertainty of the zero offset α2.
    """

    settings: Annotated[int, Field(ge=1, le=100)] = 1


class LevelSection(LevelVerb):
    """Level the platform before the block is mounted, then read the level; repeat if the tilt exceeds `within`."""

    within: Annotated[SizeRad, above_zero("state a value above 0: no platform is exactly level")] = (
        10.0 * ARCSEC
    )


class InstallationVerb(FileModel):
    """Mount the block in the installation `label`, then do the steps.

    `series` is the series number of this visit, by default the next free one of the installation. With
    `level`, the platform is levelled before the block is mounted.
    """

    label: str
    series: Positive | None = None
    level: LevelSection | None = None
    steps: Steps

    @field_validator("label")
    @classmethod
    def _oriented(cls, label: str) -> str:
        if label in UNORIENTED:
            raise ValueError(
                f"'{label}' marks readings without orientation and cannot be mounted; choose another label"
            )
        if not label.isalnum():
            raise ValueError(f"state a label of letters and digits such as '1' or 'V', not '{label}'")
        return label


class RepeatVerb(FileModel):
    """Do the steps in several passes: `times` passes, or one for each of the `directions`.

    `directions` gives the direction of the turns in each pass; `scans` gives the order in which each pass reads the
    channels, such as [xyz, zyx].
    """

    times: Positive | None = None
    directions: Annotated[tuple[DirectionWord, ...], Field(min_length=1)] | None = None
    scans: Annotated[tuple[ScanWord, ...], Field(min_length=1)] | None = None
    steps: Steps

    @model_validator(mode="after")
    def _one_of_them(self) -> RepeatVerb:
        if (self.times is None) == (self.directions is None):
            got = "none" if self.times is None else "both"
            raise ValueError(
                f"a repeat has one of 'times' and 'directions', and this one has {got}; state one"
            )
        return self

    @model_validator(mode="after")
    def _a_scan_for_each(self) -> RepeatVerb:
        if self.scans is not None and len(self.scans) != self.passes:
            raise ValueError(f"state an order in 'scans' for each pass: {self.passes}, not {len(self.scans)}")
        return self

    @property
    def passes(self) -> int:
        """The number of passes."""
        return self.times or len(self.directions or ())


class AngleSteps(FileModel):
    """Equally spaced angles: the first angle, the step, and the number of angles."""

    start: Angle = Field(alias="from")
    step: AngleRad
    count: Annotated[int, Field(ge=1, le=100_000)]

    @model_validator(mode="after")
    def _end_within_a_turn(self) -> AngleSteps:
        _within_a_turn(self.start + (self.count - 1) * self.step)
        return self

    @property
    def angles_rad(self) -> tuple[float, ...]:
        """The angles, rad."""
        return tuple(self.start + i * self.step for i in range(self.count))


class TurnVerb(FileModel):
    """Turn through angles and do the steps at each; by default, settle and take one reading.

    Points are numbered from `first_point` in the order of the list. With the direction "falling", the head
    turns through the list in reverse, and each point keeps its number.
    """

    angles: Annotated[
        Annotated[tuple[Angle, ...], Field(min_length=1), Tag("list of angles")]
        | Annotated[AngleSteps, Tag("steps of angle")],
        written_as(AngleSteps, "steps of angle", "list of angles"),
    ]
    direction: DirectionWord | None = None
    first_point: Positive = 1
    steps: Steps | None = None

    @property
    def angles_rad(self) -> tuple[float, ...]:
        """The angles in listed order, rad."""
        return self.angles.angles_rad if isinstance(self.angles, AngleSteps) else self.angles


class ReadVerb(FileModel):
    """Take one or several (`times`) readings, with a `pause` in between; each is a point, numbered in sequence.

    The defaults are in the section `reading`.
    """

    samples: Positive | None = None
    nplc: Annotated[float, Field(gt=0.0)] | None = None
    times: Annotated[int, Field(ge=1, le=100_000)] = 1
    pause: SpanS = 0.0
    on_failure: FailureSection | None = None

    @model_validator(mode="after")
    def _pause_between_two(self) -> ReadVerb:
        if self.pause and self.times == 1:
            raise ValueError("'pause' is between readings; state their number with 'times'")
        return self


class InputVerb(FileModel):
    """Switch all three inputs to a short or a reference, do the steps, switch back to the signals.

    Without steps, settle and take one reading. These readings have the installation S (short) or R (reference), and
    their points are numbered separately.
    """

    source: Literal["short", "reference"]
    voltage: VoltageV | None = None
    steps: Steps | None = None

    @model_validator(mode="after")
    def _voltage_of_a_reference(self) -> InputVerb:
        if self.source == "reference" and self.voltage is None:
            raise ValueError("the source 'reference' has no 'voltage'; add it")
        if self.source != "reference" and self.voltage is not None:
            raise ValueError(f"the source '{self.source}' takes no 'voltage'; remove it")
        return self


class WaitVerb(ActionVerb):
    """Wait for a fixed duration of bench time."""

    duration: SpanS = Field(alias="for")
    reason: str = "waiting"

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the step that waits."""
        yield Wait(key("wait"), self.duration, self.reason)


class PromptVerb(ActionVerb):
    """Ask the operator and record the answer; a dry run needs the `default`."""

    kind: PromptKind
    text: str
    default: str | None = None
    unit: Annotated[str, Field(min_length=0)] = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _default_fits(self) -> PromptVerb:
        if self.kind is PromptKind.CHOOSE and not self.choices:
            raise ValueError("a prompt of kind 'choose' has no 'choices'; add them")
        if self.kind is not PromptKind.CHOOSE and self.choices:
            raise ValueError(
                f"a prompt of kind '{self.kind.value}' takes no 'choices'; remove them, or write 'kind: choose'"
            )
        if self.kind is not PromptKind.NUMBER and not (self.minimum is None and self.maximum is None):
            raise ValueError(
                "only a prompt of kind 'number' takes 'minimum' and 'maximum'; remove them, or "
                "write 'kind: number'"
            )
        if self.default is None:
            return self
        if self.kind is PromptKind.CHOOSE and self.default not in self.choices:
            raise ValueError(f"the default '{self.default}' is not among the choices; choose one of them")
        if self.kind is PromptKind.CONFIRM and self.default not in {"yes", "no"}:
            raise ValueError(f"state yes or no as the default of a confirmation, not '{self.default}'")
        if self.kind is PromptKind.NUMBER:
            self._check_default_number(self.default)
        return self

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the step that asks the question."""
        yield Ask(key("ask"), **dict(self))

    def _check_default_number(self, default: str) -> None:
        try:
            value = float(default)
        except ValueError:
            raise ValueError(f"the default '{default}' is not a number; state a number") from None
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        if not low <= value <= high:
            raise ValueError(
                f"the default {value:g} is not between 'minimum' ({low:g}) and 'maximum' ({high:g}); correct it"
            )


class TemperatureVerb(ActionVerb):
    """Set the chamber, wait until the temperature has settled, then let the block soak."""

    at: TemperatureC
    settle: TemperatureSettle | None = None
    soak: SpanS = 0.0

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the steps that set the chamber, settle and soak."""
        yield from heating(self, self.at, key)


class TemperaturesVerb(FileModel):
    """Do the steps at each of several temperatures, each set as by the verb `temperature`.

    Inside an installation the block stays mounted, and each temperature is a separate series.
    """

    at: Annotated[tuple[TemperatureC, ...], Field(min_length=1)]
    settle: TemperatureSettle | None = None
    soak: SpanS = 0.0
    steps: Steps


def heating(
    verb: TemperatureVerb | TemperaturesVerb, at_c: float, key: Callable[[str], str]
) -> Iterator[Step]:
    """Yield the steps that bring the chamber, and the block in it, to a temperature."""
    yield SetTemperature(key("temperature"), at_c)
    if verb.settle is not None:
        yield from verb.settle.plan_steps(key)
    if verb.soak:
        yield Wait(key("wait"), verb.soak, message(f"soak at {at_c:g} °C"))


class PowerVerb(ActionVerb):
    """Switch the block on, off, or off and on again: `power: on`, `power: {switch: cycle, off_for: 10 min}`.

    In a cycle the block stays off for `off_for`, and at least for the minimum in the bench file. Once on, the block
    warms up for `warm_up`, by default as stated in the bench file.
    """

    switch: Switching
    off_for: SpanS | None = None
    warm_up: SpanS | None = None

    @model_validator(mode="before")
    @classmethod
    def _a_word(cls, written: Any) -> Any:
        return {"switch": written} if isinstance(written, str) else written

    @model_validator(mode="after")
    def _goes_together(self) -> PowerVerb:
        if self.off_for is not None and self.switch != "cycle":
            raise ValueError("only a cycle has 'off_for'; remove it")
        if self.warm_up is not None and self.switch == "off":
            raise ValueError("a block that is off does not warm up; remove 'warm_up'")
        return self

    def plan_steps(self, key: Callable[[str], str]) -> Iterator[Step]:
        """Yield the step that switches the block."""
        yield Power(key("power"), self.switch, self.off_for or 0.0, self.warm_up)


class _StepEntry(FileModel):
    """A step of a procedure file: exactly one of its verbs is stated."""

    installation: InstallationVerb | None = None
    repeat: RepeatVerb | None = None
    turn: TurnVerb | None = None
    read: ReadVerb | None = None
    input: InputVerb | None = None
    wait: WaitVerb | None = None
    settle: SettleVerb | None = None
    prompt: PromptVerb | None = None
    temperature: TemperatureVerb | None = None
    temperatures: TemperaturesVerb | None = None
    power: PowerVerb | None = None
    level: LevelVerb | None = None
    include: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _bare(cls, written: Any) -> Any:
        """Accept `- read:` and `- level:` with nothing after them; all of their settings are the defaults."""
        bare = [verb for verb in ("read", "level") if isinstance(written, dict) and verb in written]
        return {**written, bare[0]: {}} if bare and written[bare[0]] is None else written

    @model_validator(mode="after")
    def _one_verb(self) -> _StepEntry:
        given = [verb for verb in self.model_fields_set if getattr(self, verb) is not None]
        if len(given) != 1:
            given.sort(key=VERBS.index)
            got = f", not {' and '.join(given)} together" if given else ", and this one has none"
            raise ValueError(f"state one verb a step from {', '.join(VERBS)}{got}")
        return self

    @property
    def given(self) -> tuple[str, Any]:
        """The verb and its settings."""
        return next(
            (verb, getattr(self, verb)) for verb in self.model_fields_set if getattr(self, verb) is not None
        )


if TYPE_CHECKING:
    StepEntry = _StepEntry
else:
    # each kind of step in a separate module contributes its verb
    _FURTHER = {kind.NAME: (kind.VERB | None, None) for kind in KINDS if kind.VERB is not None}
    StepEntry = create_model("StepEntry", __base__=_StepEntry, __doc__=_StepEntry.__doc__, **_FURTHER)


class IncludedFile(FileModel):
    """A file of steps to include, possibly a whole procedure; its section `reading` applies to its steps."""

    procedure: str | None = None
    title: str = ""
    reading: ReadingSection | None = None
    on_failure: FailureSection | None = None
    operator_time: OperatorTimeSection = OperatorTimeSection()
    steps: Steps


class ProcedureFile(IncludedFile):
    """A procedure file: a file of steps that must state a name, `procedure`."""

    procedure: str
