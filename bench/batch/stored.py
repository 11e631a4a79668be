"""Earlier results in a run's folder, and what changed between two calibrations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import read_json, read_regular
from bench.batch.job import Row
from bench.calibration.result import LACK_OF_FIT_P
from bench.model.geometry import COEFFICIENTS
from bench.services.calibration import CalibrationResult
from bench.services.verification import VerificationResult

CALIBRATE_FILE: Final = "calibrate.json"
VERIFY_FILE: Final = "verify.json"
DIAGNOSE_FILE: Final = "diagnose.json"


@dataclass(frozen=True)
class Found:
    """A calibration as a row needs it: values and u (12,) in unit/g and unit; p of lack of fit, None unjudged."""

    estimator: str
    model: str
    unit: str
    g_m_s2: float
    values: Floats
    u: Floats
    p: float | None
    used: int
    head: str | None = None
    u_of_readings_alone: bool = False

    @property
    def fit(self) -> str:
        """Whether the model fits the readings, in a word or two."""
        if self.p is None:
            return "not judged"
        return "does not fit" if self.p < LACK_OF_FIT_P else "fits"

    @classmethod
    def of_result(cls, result: CalibrationResult) -> Found:
        """Return what was found just now."""
        own = result.calibration
        p = own.lack_of_fit.p
        return cls(
            own.estimator, own.model, own.unit, own.g_m_s2, own.block.vector, own.u,
            float(p) if np.isfinite(p) else None, own.used,
        )  # fmt: skip

    @classmethod
    def of_file(cls, told: Mapping[str, Any]) -> Found:
        """Return what a file of results tells. Raises what a dictionary that is none raises."""
        sizes = [told["coefficients"][name] for name in COEFFICIENTS]
        p = told["residual"]["p"]
        return cls(
            str(told["estimator"]),
            str(told["model"]),
            str(told["unit"]),
            float(told["g_m_s2"]),
            np.array([float(size["value"]) for size in sizes]),
            np.array([float(size["u"]) for size in sizes]),
            None if p is None else float(p),
            int(told["readings"]["used"]),
            told.get("record", {}).get("head"),
            "covariance_readings" not in told,
        )


@dataclass(frozen=True)
class Judged:
    """A verdict: whether it is accepted, the statement, and the point with the largest |Δg| (g) with its u."""

    passed: bool
    statement: str
    delta_g: float | None
    u: float | None
    limit_g: float
    rule: str

    @property
    def words(self) -> str:
        """The verdict: accepted or not, and what is stated where that says more."""
        word = "passed" if self.passed else "failed"
        plain = "pass" if self.passed else "fail"
        return word if self.statement == plain else f"{word} ({self.statement})"

    @classmethod
    def of_result(cls, result: VerificationResult) -> Judged:
        """Return the verdict found just now."""
        found = result.verification
        return cls._of(
            [(point.delta_g, point.u) for point in found.points],
            found.passed,
            str(found.statement),
            found.limit_g,
            found.rule,
        )

    @classmethod
    def of_file(cls, told: Mapping[str, Any]) -> Judged:
        """Return what a file of results tells; earlier versions said no statement."""
        passed = bool(told["passed"])
        return cls._of(
            [(float(point["delta_g"]), float(point["u"])) for point in told["points"]],
            passed,
            str(told.get("statement", "pass" if passed else "fail")),
            float(told["limit_g"]),
            str(told["rule"]),
        )

    @classmethod
    def _of(
        cls, points: list[tuple[float, float]], passed: bool, statement: str, limit_g: float, rule: str
    ) -> Judged:
        worst = max(points, key=lambda point: abs(point[0]), default=(None, None))
        return cls(passed, statement, worst[0], worst[1], limit_g, rule)


@dataclass(frozen=True)
class Named:
    """A diagnosis: its verdict, the names of what was found, and the gap (reduced chi-square) before and after."""

    verdict: str
    names: str
    before: float | None
    after: float | None

    @classmethod
    def of_file(cls, told: Mapping[str, Any]) -> Named:
        """Return what a result tells, of today or of a file."""
        gap = told.get("gap") or {}
        names = [
            " or ".join(map(str, (effect["name"], *effect.get("cannot_tell_from", ()))))
            for effect in told["effects"]
        ]
        before, after = (None if gap.get(one) is None else float(gap[one]) for one in ("before", "after"))
        return cls(str(told["verdict"]), ", ".join(names), before, after)


@dataclass(frozen=True)
class Stored:
    """What a run's folder has of each; None where there is nothing that can be read (`notes` say why)."""

    calibration: Found | None = None
    verdict: Judged | None = None
    diagnosis: Named | None = None
    notes: list[str] = field(default_factory=list)


def stored_calibration(folder: Path) -> Stored:
    """Return coefficients and verdict that a run's folder has."""
    notes: list[str] = []
    found = _read(folder / CALIBRATE_FILE, Found.of_file, notes)
    judged = _read(folder / VERIFY_FILE, Judged.of_file, notes)
    return Stored(calibration=found, verdict=judged, notes=notes)


def stored_diagnosis(folder: Path) -> Stored:
    """Return the diagnosis that a run's folder has."""
    notes: list[str] = []
    return Stored(diagnosis=_read(folder / DIAGNOSE_FILE, Named.of_file, notes), notes=notes)


def _read(file: Path, understood: Any, notes: list[str]) -> Any:
    try:
        told = read_json(read_regular(file))
        return understood(told[0] if isinstance(told, list) and len(told) == 1 else told)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as problem:
        kind = type(problem).__name__
        notes.append(f"the stored {file.name} cannot be read ({kind}: {problem}): nothing to compare with")
        return None


def changes(before: Found | None, now: Found) -> Row:
    """Return the columns of what was, what is and what changed; without a result before, of what is alone.

    Readings are the same, so that the change is no deviation by chance: it is in units of the u that was stated,
    of what had none (fixed by convention) in units of the u that it has now. Where neither has one it is zero
    or unknown, and results in different units of the signals are not compared.
    """
    row: Row = {**_columns(now, ""), **({} if before is None else _columns(before, "_stored"))}
    if before is None:
        return row
    row["fit_differs"] = before.fit != now.fit
    if before.unit != now.unit:
        return row
    change = change_in_u(before, now)
    row |= {f"{name}_change_in_u": _known(x) for name, x in zip(COEFFICIENTS, change, strict=True)}
    if not np.all(np.isnan(change)):
        largest = int(np.nanargmax(np.abs(change)))
        row |= {
            "largest_change_in_u": abs(float(change[largest])),
            "largest_change_of": COEFFICIENTS[largest],
        }
    both = (before.u > 0) & (now.u > 0)
    if np.any(both):
        ratio = now.u[both] / before.u[both]
        row |= {"least_u_ratio": float(ratio.min()), "most_u_ratio": float(ratio.max())}
    return row


def change_in_u(before: Found, now: Found) -> Floats:
    """Return how far each coefficient went, (12,), in units of its u; NaN where it went and has none."""
    moved = now.values - before.values
    unit = np.where(before.u > 0, before.u, now.u)
    with np.errstate(divide="ignore", invalid="ignore"):
        change: Floats = np.where(unit > 0, moved / unit, np.where(moved == 0, 0.0, np.nan))
    return change


def _columns(found: Found, suffix: str) -> Row:
    return {
        f"estimator{suffix}": found.estimator,
        f"model{suffix}": found.model,
        f"signal_unit{suffix}": found.unit,
        f"g{suffix}_m_s2": found.g_m_s2,
        f"fit{suffix}": found.fit,
        f"p{suffix}": found.p,
        **{f"{name}{suffix}": x for name, x in zip(COEFFICIENTS, found.values.tolist(), strict=True)},
        **{f"u_{name}{suffix}": x for name, x in zip(COEFFICIENTS, found.u.tolist(), strict=True)},
    }


def _known(x: float) -> float | None:
    return None if np.isnan(x) else float(x)
