"""Cases of the trial made from a seed: readings for the program, and the sealed answers."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from bench.readings.table import JoinedPart, Readings, make_readings, together
from benchmarks.blind_trial.effects import BLOCK, CATALOGUE, CLASS_OF, HIDDEN, SEEN_IN_VERIFICATION, STAND
from benchmarks.blind_trial.free_positions import FREE, free_tables
from benchmarks.blind_trial.mistakes import MISTAKES, SLIPS, Mistake
from benchmarks.blind_trial.outside import (
    COMMON_VOLTS,
    HAND_SET,
    OTHER_PSI,
    OUTSIDE,
    OWN,
    REPAIRED,
    SENSITIVE,
    SUPPLIED,
    common_volts,
    courses,
    hand_set,
    recorded,
    sensitive,
    stated_psi_deg,
)
from benchmarks.blind_trial.signals import (
    SETTING_SIGMA,
    STAND_SIGMA,
    Visibility,
    scaled_to,
    signals,
    signature,
    visibility,
)
from benchmarks.blind_trial.stand import (
    CHANNELS,
    REFERENCE_TEMPERATURE_C,
    Draw,
    Floats,
    Run,
    Truth,
    Weather,
    make_run,
)

# --- realistic noise -------------------------------------------------------------------------------------


BY_CHANNEL: Final = np.array([9.0, 15.0, 33.0]) / 15.0
TAIL_DOF: Final = 4
SLOW_PART: Final = 0.5
COARSE: Final = 2.0
"""Last digit of the signals, in standard deviations of the noise."""

NOISES: Final = ("equal", "by channel", "t4", "1/f", "coarse")


def noise_of(rng: np.random.Generator, kind: str, n: int) -> Floats:
    """Return noise (n, 3) of a kind of `NOISES`, in units of the stated size.

    "by channel" has 9/15, 15/15 and 33/15 of the stated size; "t4" is a t distribution with 4 degrees of freedom.
    """
    if kind == "t4":  # of the stated standard deviation
        return np.asarray(rng.standard_t(TAIL_DOF, (n, 3)) * np.sqrt((TAIL_DOF - 2) / TAIL_DOF))
    white = rng.normal(size=(n, 3))
    if kind == "by channel":
        return np.asarray(white * BY_CHANNEL)
    if kind == "1/f":
        return white + SLOW_PART * _slow(rng, n)
    return white


def _slow(rng: np.random.Generator, n: int) -> Floats:
    """Return 1/f noise (n, 3) over the readings, rms 1 in each channel, cut from a series eight times as long."""
    long = 8 * n
    frequency = np.fft.rfftfreq(long)
    size = np.zeros(len(frequency))
    size[1:] = 1 / np.sqrt(frequency[1:])
    wave = rng.normal(size=(len(frequency), 3)) + 1j * rng.normal(size=(len(frequency), 3))
    course = np.fft.irfft(size[:, None] * wave, long, axis=0)[:n]
    course -= course.mean(axis=0)
    return np.asarray(course / np.sqrt(np.mean(course**2, axis=0)))


# --- cases -----------------------------------------------------------------------------------------------


READING_NOISE_V: Final = 15e-6
MOST_TIMES_PLAUSIBLE: Final = 15.0
"""Largest size of a hidden effect, in plausible sizes."""
HIDDEN_TIMES_PLAUSIBLE: Final = 10.0
DECIMALS: Final = 7
TRIES: Final = 5


@dataclass(frozen=True)
class Row:
    """A row of the score table: hidden effect, design, visibility, noise, and number of cases.

    `kind` is null, single, pair, outside, hidden, equal_k2, mounting_roll, one of `SLIPS`, `KNOWN`,
    `SUPPLIED` or mistake:NAME, or one of `FREE`, which has its own noise and design. `noise_v` is the noise
    that the bench file states; the true noise of readings and settings is `noise_factor` times as large.
    `noise` is its kind (`NOISES`). The `runs` of a case have the same effect, each with visibility `rho`;
    with `blocks`, each has another block.
    """

    kind: str
    design: str = "paper"
    rho: float | None = None
    noise_v: float = READING_NOISE_V
    noise_factor: float = 1.0
    count: int = 100
    noise: str = "equal"
    runs: int = 1
    blocks: bool = False

    @property
    def key(self) -> str:
        """The name of the row in tables and seeds."""
        visible = "" if self.rho is None else f" rho {self.rho:g}"
        factor = "" if self.noise_factor == 1 else f" x{self.noise_factor:g}"
        of = "a block each" if self.blocks else "one block"
        several = f", {self.runs} runs of {of}" if self.runs > 1 else ""
        noise = "" if self.noise == "equal" else f", {self.noise}"
        unit = "ug" if self.kind in FREE else "uV"
        return f"{self.kind} {self.design}{visible} {self.noise_v * 1e6:g} {unit}{factor}{noise}{several}"


@dataclass(frozen=True)
class Case:
    """The input of the diagnosis: a table of readings, and the noise that the bench file states (1 σ).

    `reading_noise_v` is in V, `setting_noise` in rad. With `own`, the diagnosis also gets user formulas.
    `stated_psi_deg` is the wrong angle of the verification points in the bench file, None if it is right. For
    free positions, `free` are the records. The name does not reveal what is hidden.
    """

    id: str
    design: str
    readings: Readings
    reading_noise_v: float
    setting_noise: float
    own: bool = False
    stated_psi_deg: float | None = None
    free: tuple[Readings, ...] = ()


@dataclass(frozen=True)
class HiddenEffect:
    """A hidden effect, with its visibility `rho` from the fitted rows alone and with the verification rows.

    `change` (n, 3), V, is its signature in all rows on a stand without errors.
    """

    name: str
    channels: tuple[str, ...]
    mounts: tuple[str, ...]
    shape: str
    amplitude: float
    parameters: dict[str, float]
    rho: float
    rho_with_verification: float
    change: Floats = field(repr=False, compare=False)


@dataclass(frozen=True)
class Answer:
    """The effects or the mistake hidden in a case; for a mistake, `accepted` are its right names."""

    id: str
    row: Row
    index: int
    seed: int
    effects: tuple[HiddenEffect, ...] = ()
    place: str = ""
    accepted: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        return self.row.kind

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the effects or of the mistake."""
        return tuple(effect.name for effect in self.effects) or self.accepted[:1]

    def as_json(self) -> str:
        """Canonical JSON text, identical for equal answers."""
        effects = [
            {k: v for k, v in vars(effect).items() if k != "change"}
            | {"rho": round(effect.rho, 6), "rho_with_verification": round(effect.rho_with_verification, 6)}
            for effect in self.effects
        ]
        content = {**vars(self), "row": self.row.key, "effects": effects}
        return json.dumps(content, sort_keys=True)


def make_case(seed: int, row: Row, index: int) -> tuple[Case, Answer]:
    """Make case `index` of a row; equal seed, row and index give the same case."""
    digest = _digest(seed, row, index)
    rng = np.random.default_rng(list(digest))
    if row.kind in FREE:
        return _free_case(rng, digest.hex()[:12], seed, row, index)
    run, truths, above_v = _hide(rng, row, index)
    mistake = (
        MISTAKES[row.kind.removeprefix("mistake:")](rng, run) if row.kind.startswith("mistake:") else None
    )
    if row.kind == REPAIRED:
        mistake = MISTAKES["outlier"](rng, run)
    readings = _measure(rng, row, run, truths, mistake)
    if above_v is not None:
        readings = replace(readings, extra={**readings.extra, **recorded(rng, above_v)})
    if row.runs > 1:
        tables = [readings, *(_measure(rng, row, _run(rng, row), truths, None) for _ in range(1, row.runs))]
        tables = [_of_another_block(rng, table) for table in tables] if row.blocks else tables
        readings = together([JoinedPart(table) for table in tables])
    case = Case(digest.hex()[:12], row.design, readings, row.noise_v, SETTING_SIGMA, row.kind == "own")
    if row.kind == OTHER_PSI:
        case = replace(case, stated_psi_deg=stated_psi_deg(rng))
    answer = Answer(case.id, row, index, seed, tuple(_hidden(t, run, row) for t in truths))
    if mistake is not None:
        answer = replace(answer, place=mistake.place, accepted=mistake.names)
    return case, answer


def hidden_in(seed: int, row: Row, index: int) -> tuple[Run, list[Truth]]:
    """Return the run of a case, and the effects hidden in it."""
    return _hide(np.random.default_rng(list(_digest(seed, row, index))), row, index)[:2]


def _digest(seed: int, row: Row, index: int) -> bytes:
    return hashlib.sha256(f"{seed}/{row.key}/{index}".encode()).digest()


def _hide(rng: np.random.Generator, row: Row, index: int) -> tuple[Run, list[Truth], Floats | None]:
    """Return the run of a case, the hidden effects, and the rail voltages over time (None without a supply)."""
    run = _run(rng, row)
    if row.kind not in SUPPLIED:
        return run, _truths(rng, row, run, index), None
    above_v = courses(rng, run)
    return run, [_of_the_supply(rng, row, run, above_v)], above_v


def _free_case(rng: np.random.Generator, name: str, seed: int, row: Row, index: int) -> tuple[Case, Answer]:
    tables, truth, rho = free_tables(rng, row.kind, row.rho)
    readings = together([JoinedPart(table) for table in tables]) if len(tables) > 1 else tables[0]
    answer = Answer(name, row, index, seed)
    if truth is not None:
        channels = tuple(CHANNELS[c] for c in truth.channels)
        change = np.concatenate(truth.added)
        effect = HiddenEffect(truth.name, channels, ("F",), row.kind, rho, {}, rho, rho, change)
        answer = replace(answer, effects=(effect,))
    return Case(name, row.design, readings, row.noise_v, 0.0, free=tables), answer


def _run(rng: np.random.Generator, row: Row) -> Run:
    """Return a run of the row's design with random temperatures."""
    phase, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1])
    return make_run(row.design).with_weather(
        Weather(float(phase), turn * 0.25 / 7200, float(rng.normal(0, 0.1)))
    )


def _of_another_block(rng: np.random.Generator, table: Readings) -> Readings:
    """Return the readings of a block with other scale factors (by some per cent) and zeros (by some 10 mV)."""
    signal = table.signal * (1 + rng.normal(0, 0.02, 3)) + rng.normal(0, 0.05, 3)
    return replace(table, signal=np.round(signal, DECIMALS))


def seal(case: Case, answer: Answer) -> dict[str, str]:
    """Return the ledger line of a case: its name, and the SHA-256 of readings and answer."""
    table = case.readings
    columns = (table.angle_rad, table.time_s, table.temperature_c, table.signal)
    content = hashlib.sha256("\n".join(table.installation).encode())
    for column in columns:
        content.update(np.ascontiguousarray(column).tobytes())
    sealed = hashlib.sha256(answer.as_json().encode()).hexdigest()
    return {"id": case.id, "readings_sha256": content.hexdigest(), "answer_sha256": sealed}


def _true_visibility(row: Row, *, verification: bool = False) -> Visibility:
    """Return the visibility of effects at the true noise of the run."""
    factor = row.noise_factor
    return visibility(row.design, row.noise_v * factor, SETTING_SIGMA * factor, verification=verification)


def _hidden(truth: Truth, run: Run, row: Row) -> HiddenEffect:
    change = signature(run, truth)
    return HiddenEffect(
        truth.name, truth.channels, truth.mounts, truth.shape, float(truth.amplitude),
        {k: float(v) for k, v in truth.parameters.items()}, _true_visibility(row).rho(change),
        _true_visibility(row, verification=True).rho(change), change,
    )  # fmt: skip


def _truths(rng: np.random.Generator, row: Row, run: Run, index: int) -> list[Truth]:
    if row.kind == "hidden":
        # a wobble's cosine is hidden only without verification points, which show its change of Kyz and Kzy
        verified = bool(np.any(run.labels == "V"))
        names = [name for name in HIDDEN if not (verified and name == "axis_wobble")]
        name = names[index % len(names)]
        return [HIDDEN[name](rng, run).scaled(HIDDEN_TIMES_PLAUSIBLE)]
    if row.kind == HAND_SET:
        return [hand_set(rng, run)]
    if row.rho is None:
        return []
    seen = _true_visibility(row, verification=row.kind == SEEN_IN_VERIFICATION)
    match row.kind:
        case "single" | "repaired":
            names = [n for n in CATALOGUE if not (row.blocks and n in BLOCK)]
            return [_next(rng, row, run, seen, names, index)]
        case "own":
            return [_next(rng, row, run, seen, list(OWN), index, OWN)]
        case "pair":
            first = _next(rng, row, run, seen, list(CATALOGUE), index)
            others = [name for name in CATALOGUE if CLASS_OF[name] != CLASS_OF[first.name]]
            return [first, _next(rng, row, run, seen, others, int(rng.integers(len(others))))]
        case "outside":
            return [_scaled(rng, row, run, seen, OUTSIDE[list(OUTSIDE)[index % len(OUTSIDE)]])]
        case kind if kind in ALONE:
            return [_scaled(rng, row, run, seen, ALONE[kind])]
        case _:
            raise ValueError(f"No such kind of case: {row.kind}.")


def _of_the_supply(rng: np.random.Generator, row: Row, run: Run, above_v: Floats) -> Truth:
    if row.kind != SENSITIVE:  # a drift, independent of the rails
        return _scaled(rng, row, run, _true_visibility(row), BLOCK["bias_drift"])
    return _scaled(rng, row, run, _true_visibility(row), lambda r, of: sensitive(r, of, above_v))


def _equal_k2(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of an equal K2 in all three channels, typical of a type of accelerometer."""
    sign = rng.choice([-1.0, 1.0])
    return Truth(
        "quadratic_nonlinearity", "block", lambda _, force, x: sign * 30e-6 * x * force**2,
        channels=CHANNELS, shape="equal",
    )  # fmt: skip


ALONE: Final[dict[str, Draw]] = {
    COMMON_VOLTS: common_volts, "equal_k2": _equal_k2, SEEN_IN_VERIFICATION: STAND[SEEN_IN_VERIFICATION], **SLIPS,
}  # fmt: skip
"""The effect of each kind of case that hides one effect."""


def _next(
    rng: np.random.Generator,
    row: Row,
    run: Run,
    seen: Visibility,
    names: list[str],
    start: int,
    draws: Mapping[str, Draw] = CATALOGUE,
) -> Truth:
    """Draw the next effect of `names`, skipping those that this design cannot show at a plausible size."""
    for k in range(len(names)):
        draw = draws[names[(start + k) % len(names)]]
        truth = _attempt(rng, row, run, seen, draw, MOST_TIMES_PLAUSIBLE)
        if truth is not None:
            return truth
    raise ValueError(f"No effect reaches rho {row.rho} in the design {row.design}.")


def _scaled(rng: np.random.Generator, row: Row, run: Run, seen: Visibility, draw: Draw) -> Truth:
    truth = _attempt(rng, row, run, seen, draw, np.inf)
    if truth is None:
        raise ValueError(f"{draw(rng, run).name} cannot be seen in the design {row.design}.")
    return truth


def _attempt(
    rng: np.random.Generator, row: Row, run: Run, seen: Visibility, draw: Draw, most: float
) -> Truth | None:
    for _ in range(TRIES):
        truth = scaled_to(draw(rng, run), run, float(row.rho or 0), seen, most)
        if truth is not None:
            return truth
    return None


def _rounded(signal: Floats, row: Row) -> Floats:
    """Return signals rounded to their last digit, or to steps coarser than the noise."""
    if row.noise != "coarse":
        return np.round(signal, DECIMALS)
    step = COARSE * row.noise_v * row.noise_factor
    return np.asarray(np.round(np.round(signal / step) * step, DECIMALS + 2))


def _measure(
    rng: np.random.Generator, row: Row, run: Run, truths: list[Truth], mistake: Mistake | None
) -> Readings:
    """Simulate the run on a stand with errors within the paper's limits, and return its table of readings."""
    n = len(run.mount)
    stand = rng.normal(size=(int(run.mount.max()) + 1, 3)) * STAND_SIGMA
    setting = rng.normal(0, SETTING_SIGMA * row.noise_factor, n)
    noise = noise_of(rng, row.noise, n) * row.noise_v * row.noise_factor
    signal = signals(run, truths, stand, setting, None if mistake is None else mistake.true_angle) + noise
    labels = run.labels
    if mistake is not None:
        signal = mistake.edit(signal)
        labels = labels if mistake.labels is None else mistake.labels
    table = make_readings(
        labels.tolist(), run.pass_number.tolist(), run.point.tolist(), run.angle, _rounded(signal, row),
        source="blind trial", target_rad=run.angle, series=run.series.tolist(),
        direction=run.direction.tolist(), time_s=run.time_s,
        temperature_c=np.round(REFERENCE_TEMPERATURE_C + run.temperature(), 3),
    )  # fmt: skip
    extra = {"scan_order": run.scan}
    if not run.measured.all():
        extra["reference_v"] = np.array(
            [f"{v:g}" if lab == "R" else "" for lab, v in zip(run.labels, run.input_v, strict=True)]
        )
    return replace(table, extra=extra)
