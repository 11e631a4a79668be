"""The calibration and measurement capability that a laboratory's history shows, corrected for unit drift."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.result import CalibrationError
from bench.history.measured import ComparedCalibrations, coded
from bench.model.geometry import COEFFICIENTS
from bench.stats.crossed_effects import Crossing
from bench.stats.unit_histories import CalibrationSpread, Histories, Within, histories, spread_of

EVERYDAY: Final = 0.5
"""The default quantile of the stated u: the median."""
CONFIDENCE: Final = 0.95
LEAST_CALIBRATIONS: Final = 20
LEAST_REPEATS: Final = 10
"""Least number of repeated calibrations: their standard deviation then has a relative uncertainty of 22 %."""
LEAST_DAYS: Final = 180
LEAST_RUNS: Final = 3
"""Least number of runs of a unit from which its drift is estimated."""
YEAR: Final = np.timedelta64(31_557_600, "s")


@dataclass(frozen=True)
class Capability:
    """The calibration and measurement capability of a laboratory, for twelve coefficients.

    Arrays are (12,), in `signal` per g for scale factors and in `signal` for biases, with g = `STANDARD_GRAVITY`.
    `stated` is a quantile of the stated u, at the probability `quantile`; `stated_most` is its upper 95 % limit.
    `spreads` holds, by coefficient, the scatter of repeated calibrations in excess of the stated u, the standard
    deviation between benches, and the drift. `below` counts the calibrations whose stated U is below the
    capability: their certificates must state the capability instead.
    """

    quantile: float
    stated: Floats
    stated_most: Floats
    spreads: tuple[CalibrationSpread, ...]
    below: Floats
    counts: dict[str, Any]
    signal: str
    simulated: bool
    notes: tuple[str, ...]

    @property
    def scatter(self) -> Floats:
        """Scatter of repeated calibrations in excess of the stated u, 1 σ, (12,)."""
        return np.array([one.scatter for one in self.spreads])

    @property
    def bench(self) -> Floats:
        """Standard deviation between benches, (12,); NaN for a single bench."""
        return np.array([one.bench for one in self.spreads])

    @property
    def u(self) -> Floats:
        """The combined standard uncertainty of the capability, (12,)."""
        return np.sqrt(self.stated**2 + self.scatter**2 + np.nan_to_num(self.bench) ** 2)

    @property
    def U(self) -> Floats:  # noqa: N802 - the symbol of the field
        """The expanded uncertainty of the capability, k = 2, (12,)."""
        return COVERAGE_FACTOR * self.u


def capability(measured: ComparedCalibrations, quantile: float = EVERYDAY) -> Capability:
    """Return the capability that a laboratory's calibrations show.

    Raises `CalibrationError` if the history is too short; the message lists everything that it lacks.
    """
    (units, unit), (benches, bench) = coded(measured.unit), coded(measured.bench)
    _, kind = coded(measured.kind)
    crossing = Crossing(unit, bench, kind)
    days = int((measured.when.max() - measured.when.min()) / np.timedelta64(1, "D"))
    several = len(benches) > 1
    _refuse_short(crossing, days, several=several)
    of = histories(unit, bench, (measured.when - measured.when.min()) / YEAR)
    told = bool(np.any(of.runs >= LEAST_RUNS))
    found = tuple(
        spread_of(Within(of, y, v), several=several, drifts=told)
        for y, v in zip(measured.vector.T, measured.own_variance.T, strict=True)
    )
    stated = np.sort(np.sqrt(measured.variance), axis=0)
    ranks = _ranks(len(measured), quantile)
    shown = Capability(
        quantile, stated[ranks[0]], stated[ranks[1]], found, np.zeros(len(COEFFICIENTS)),
        {
            "calibrations": len(measured), "units": len(units), "benches": benches.tolist(), "days": days,
            "first": str(measured.when.min().astype("datetime64[D]")),
            "last": str(measured.when.max().astype("datetime64[D]")),
            "repeats": crossing.repeated, "units_with_too_few_runs": int(np.sum(of.runs < LEAST_RUNS)),
        },
        measured.signal, measured.simulated, _notes(found, of, several=several),
    )  # fmt: skip
    below = np.sum(np.sqrt(measured.variance) < shown.u, axis=0)
    return replace(shown, below=below.astype(float))


def _notes(found: tuple[CalibrationSpread, ...], of: Histories, *, several: bool) -> tuple[str, ...]:
    runs = of.runs
    few = int(np.sum(runs < LEAST_RUNS))
    notes = []
    if few == len(runs):
        notes.append(
            message(
                f"no unit has {LEAST_RUNS} runs: the drift of units cannot be estimated and is part of the "
                "scatter over time"
            )
        )
    else:
        drifting = [name for name, one in zip(COEFFICIENTS, found, strict=True) if one.shown]
        out = message("is not shown in any coefficient")
        if drifting:
            out = message(f"is taken out in {', '.join(drifting)}")
        notes.append(
            message(f"a drift of units {out}; elsewhere a possible drift is part of the scatter over time")
        )
        if few:
            notes.append(
                message(
                    f"{few} of {len(runs)} units have fewer than {LEAST_RUNS} runs, too few to estimate their "
                    "own drift; it is assumed as large as for the others"
                )
            )
    if many := int(np.sum(runs > of.longest)):
        notes.append(
            message(
                f"{many} units have more than {of.longest} runs; {of.longest} of each, spread evenly in time, "
                "give scatter and drift"
            )
        )
    if not several:
        notes.append(message("one bench alone: differences between benches are not included"))
    return tuple(notes)


def _ranks(count: int, quantile: float) -> tuple[int, int]:
    """Return the indices, in `count` ascending values, of a quantile and of its upper 95 % limit."""
    place = min(count - 1, int(np.ceil(quantile * count)) - 1)
    limit = int(stats.binom.ppf(CONFIDENCE, count, quantile))
    return max(place, 0), min(limit, count - 1)


def _refuse_short(crossing: Crossing, days: int, *, several: bool) -> None:
    lacks = []
    if len(crossing.unit) < LEAST_CALIBRATIONS:
        lacks.append(message(f"{len(crossing.unit)} calibrations ({LEAST_CALIBRATIONS} are needed)"))
    if crossing.repeated < LEAST_REPEATS:
        lacks.append(
            message(f"{crossing.repeated} repeated calibrations of a unit ({LEAST_REPEATS} are needed)")
        )
    if days < LEAST_DAYS:
        lacks.append(message(f"{days} days between the first and the last ({LEAST_DAYS} are needed)"))
    if several and len(crossing.alone()):
        lacks.append(
            message("benches that share no unit with another (measure a unit of another bench on each)")
        )
    if lacks:
        raise CalibrationError(
            f"the history is too short for a statement of capability; more is needed: {'; '.join(lacks)}"
        )
