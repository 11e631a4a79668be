"""The unit of work: making a row from a run and a job. It writes nothing into the run's folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import isnan
from pathlib import Path
from threading import Lock
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import read_json, read_regular, to_text, write_whole
from bench.base.text import visible
from bench.batch.job import DIAGNOSE, REPORT, Job, Row
from bench.calibration.result import LACK_OF_FIT_P
from bench.config.formulas import effects_in
from bench.model import CATALOGUE, Effect
from bench.model.geometry import COEFFICIENTS
from bench.run.events import RecordError, read_manifest, sha256
from bench.run.folder import CALIBRATE_FILE, DIAGNOSE_FILE, VERIFY_FILE, statement_in
from bench.services.bodies import body_of
from bench.services.calibration import CalibrationResult, calibrated, report_page, verification_of
from bench.services.diagnosis import diagnosis_of
from bench.services.errors import sentence
from bench.services.requests.evaluation import Calibrate
from bench.services.source import Source, load_sources
from bench.services.stability import RecordCalibrationResult
from bench.services.verification import VerificationResult

_ONE_AT_A_TIME: Final = Lock()
"""Lock by which a process computes one run at a time: the registered effects apply to the whole process."""


def worked(job: Job, run: str) -> Row:
    """Return the row of a run; if it cannot be analysed, the column `failed` states the reason."""
    row: Row = {"run": run, "name": Path(run).name}
    with _ONE_AT_A_TIME:
        try:
            row |= _told_by_manifest(Path(run))
            with CATALOGUE.also(_effects(job.effects)):
                row |= _of_run(job, run)
        except Exception as error:  # a bad run never ends the batch; the table lists its error
            row["failed"] = visible(sentence(error))
    return row


def _told_by_manifest(folder: Path) -> Row:
    try:
        manifest = read_manifest(folder)
    except RecordError:
        return {}  # the reader of the run reports this error
    unit = manifest.get("unit_under_test")
    said = manifest.get("versions", {})
    return {
        "simulated": bool(manifest.get("dry_run")),
        "begun": manifest.get("created"),
        "measured_with": said.get("triaxial-bench"),
        **({"unit_type": unit["type"], "serial": unit["serial"]} if unit else {}),
    }


@lru_cache(maxsize=1)
def _effects(files: tuple[str, ...]) -> tuple[Effect, ...]:
    return tuple(effects_in(files))


def _of_run(job: Job, run: str) -> Row:
    (source,) = load_sources(job.request(run))
    row: Row = {"bench": source.bench.name, "simulated": source.simulated}
    if source.block_name:
        row |= {"unit_type": source.bench.unit_under_test.type, "serial": source.bench.unit_under_test.serial}
    if job.command == DIAGNOSE:
        return row | _diagnosed(source)
    return row | _calibrated(job, source)


# --- calibrate and report ---------------------------------------------------------------------------


def _calibrated(job: Job, source: Source) -> Row:
    asked = Calibrate(
        source.name, estimator=job.estimator, nominal_angles=job.nominal_angles, join_free=job.join_free,
        join_verification=job.join_verification,
    )  # fmt: skip
    result = calibrated(asked, source)
    if not isinstance(result, CalibrationResult):
        return _of_meters(job, source, result)
    row: Row = {}
    verdict: VerificationResult | None = None
    if job.command == REPORT:
        page, verdict = report_page(result, job.asked())
        row["page"] = str(_written(job, source, page))
    elif len(source.readings.verification()) and not job.join_verification:
        verdict = verification_of(result.source, result, job.asked())
    return row | _compared(result, verdict, Path(source.name))


def _of_meters(job: Job, source: Source, result: RecordCalibrationResult) -> Row:
    """Return the columns for a record at a known input: gain and offset of each channel, new and stored."""
    row: Row = {}
    if job.command == REPORT:
        row["page"] = str(_written(job, source, report_page(result, job.asked())[0]))
    told, notes = result.to_dict(), [*result.notes]
    now = _meters_of(told)
    before = _read(Path(source.name) / CALIBRATE_FILE, _meters_of, notes) or {}
    moved = {
        name: (value - before[name][0]) / before[name][1]
        for name, (value, _) in now.items()
        if name in before and before[name][1] > 0
    }
    for values, suffix in ((now, ""), (before, "_stored")):
        row |= {f"{name}{suffix}": value for name, (value, _) in values.items()}
        row |= {f"u_{name}{suffix}": u for name, (_, u) in values.items()}
    row |= {f"{name}_change_in_u": change for name, change in moved.items()}
    if moved:
        largest = max(moved, key=lambda name: abs(moved[name]))
        row |= {"largest_change_in_u": abs(moved[largest]), "largest_change_of": largest}
    own = {"estimator": told["estimator"], "model": told["model"], "signal_unit": told["unit"]}
    return row | own | {"readings_used": told["readings"]["used"], "notes": "; ".join(map(visible, notes))}


def _meters_of(told: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return value and u of each gain and offset in a stored result, by column of the table."""
    return {
        f"{what}_{channel}": (float(part[what]["value"]), float(part[what]["u"]))
        for channel, part in told["channels"].items()
        for what in ("gain", "offset_v")
        if part[what] is not None
    }


def _written(job: Job, source: Source, page: str) -> Path:
    """Write the page of a run; return its path. Runs in different folders may have the same name."""
    folder = Path(source.name)
    place = f"{folder.parent.name}-{sha256(str(folder.parent).encode())[:6]}"
    file = Path(job.pages) / place / f"{folder.name}.html"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, page)
    return file


def _compared(result: CalibrationResult, verdict: VerificationResult | None, folder: Path) -> Row:
    """Return the columns of a calibration and its verdict, and of those stored in the folder of the run."""
    notes: list[str] = []
    now, before = CalibrationValues.of_file(result.to_dict()), stored_calibration(folder, notes)
    judged = None if verdict is None else VerdictValues.of_file(verdict.to_dict())
    judged_before: VerdictValues | None = _read(folder / VERIFY_FILE, VerdictValues.of_file, notes)
    notes += [*(() if before is None else _notes_on(before, result)), *result.notes]
    return {
        **changes(before, now),
        **_verdicts(judged_before, judged),
        "readings_used": now.used,
        "covariance": result.covariance.ravel().tolist(),
        "notes": "; ".join(map(visible, notes)),
    }


def _notes_on(before: CalibrationValues, result: CalibrationResult) -> Iterator[str]:
    run = result.source.run
    if run is not None and before.head is not None and before.head != run.history.head:
        yield "the stored result is of an earlier state of the record (its head differs)"
    if before.u_of_readings_alone:
        yield "the stored u is from an earlier version and covers the readings alone"


def _verdicts(before: VerdictValues | None, now: VerdictValues | None) -> Row:
    row: Row = {}
    for one, suffix in ((before, "_stored"), (now, "")):
        if one is not None:
            row |= {
                f"verdict{suffix}": one.words,
                f"worst_delta_g{suffix}": one.delta_g,
                f"worst_delta_g_u{suffix}": one.u,
                f"limit_g{suffix}": one.limit_g,
                f"rule{suffix}": one.rule,
            }
    if before is not None and now is not None:
        row["verdict_differs"] = before.words != now.words
    return row


# --- diagnose ---------------------------------------------------------------------------------------


def _diagnosed(source: Source) -> Row:
    found = _diagnosis(source)
    notes: list[str] = []
    now = Named.of_file(found)
    before: Named | None = _read(Path(source.name) / DIAGNOSE_FILE, Named.of_file, notes)
    notes += [*source.readings.notes, *found.get("notes", ())]
    row: Row = {"model": source.model.name, "result": to_text(found), "notes": "; ".join(map(visible, notes))}
    for one, suffix in ((before, "_stored"), (now, "")):
        if one is not None:
            row |= {
                f"verdict{suffix}": one.verdict,
                f"names{suffix}": one.names,
                f"gap_before{suffix}": one.before,
                f"gap_after{suffix}": one.after,
            }
    if before is not None:
        row["verdict_differs"], row["names_differ"] = before.verdict != now.verdict, before.names != now.names
    return row


def _diagnosis(source: Source) -> dict[str, Any]:
    return diagnosis_of(body_of([source])).to_dict()


# --- earlier results, and what changed ----------------------------------------------------------------


@dataclass(frozen=True)
class CalibrationValues:
    """The calibration in a row of the table.

    `values` and `u` (12,) are in the order of `COEFFICIENTS`, in `unit` per g and `unit`. `p` is the p-value
    of the test of lack of fit, None if the fit was not judged. `used` is the number of readings used, `head`
    the end of the record's hash chain (None without a record). `u_of_readings_alone` marks a `u` that has
    only the part from the readings, as in results of earlier versions.
    """

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
        """Whether the model fits the readings, in one or two words."""
        if self.p is None:
            return "not judged"
        return "does not fit" if self.p < LACK_OF_FIT_P else "fits"

    @classmethod
    def of_file(cls, told: Mapping[str, Any]) -> CalibrationValues:
        """Return the calibration in a result's parsed JSON. Other JSON raises `KeyError` or the like."""
        sizes = [told["coefficients"][name] for name in COEFFICIENTS]
        p = told["residual"]["p"]
        return cls(
            str(told["estimator"]),
            str(told["model"]),
            str(told["unit"]),
            float(told["g_m_s2"]),
            np.array([float(size["value"]) for size in sizes]),
            # null for a coefficient that is zero by convention
            np.array([np.nan if size["u"] is None else float(size["u"]) for size in sizes]),
            None if p is None else float(p),
            int(told["readings"]["used"]),
            told.get("record", {}).get("head"),
            "covariance_readings" not in told,
        )


@dataclass(frozen=True)
class VerdictValues:
    """A verdict: acceptance, statement, Δg of largest magnitude with its u (g, or None), limit, rule."""

    passed: bool
    statement: str
    delta_g: float | None
    u: float | None
    limit_g: float
    rule: str

    @property
    def words(self) -> str:
        """The verdict in words: accepted or not, and the statement if that says more."""
        word = "passed" if self.passed else "failed"
        plain = "pass" if self.passed else "fail"
        return word if self.statement == plain else f"{word} ({self.statement})"

    @classmethod
    def of_file(cls, told: Mapping[str, Any]) -> VerdictValues:
        """Return the verdict in `told`, the result of a verification as JSON."""
        points = [(float(point["delta_g"]), float(point["u"])) for point in told["points"]]
        delta_g, u = max(points, key=lambda point: abs(point[0]), default=(None, None))
        passed, statement = bool(told["passed"]), statement_in(told)
        return cls(passed, statement, delta_g, u, float(told["limit_g"]), str(told["rule"]))


@dataclass(frozen=True)
class Named:
    """A diagnosis: its verdict and the names of the effects found.

    `before` and `after` are the reduced chi-square of held-out readings without and with them, or None.
    """

    verdict: str
    names: str
    before: float | None
    after: float | None

    @classmethod
    def of_file(cls, told: Mapping[str, Any]) -> Named:
        """Return the diagnosis in `told`, the parsed JSON of a result."""
        gap = told.get("gap") or {}
        names = [
            " or ".join(map(str, (effect["name"], *effect.get("cannot_tell_from", ()))))
            for effect in told["effects"]
        ]
        before, after = (None if gap.get(one) is None else float(gap[one]) for one in ("before", "after"))
        return cls(str(told["verdict"]), ", ".join(names), before, after)


def stored_calibration(folder: Path, notes: list[str]) -> CalibrationValues | None:
    """Return the calibration stored in a run's folder, or None; errors of reading go to `notes`."""
    found: CalibrationValues | None = _read(folder / CALIBRATE_FILE, CalibrationValues.of_file, notes)
    return found


def _read(file: Path, understood: Any, notes: list[str]) -> Any:
    """Return an earlier result, parsed by `understood`; None if missing or unreadable (`notes` then say why)."""
    try:
        told = read_json(read_regular(file))
        return understood(told[0] if isinstance(told, list) and len(told) == 1 else told)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as problem:
        kind = type(problem).__name__
        notes.append(f"the stored {file.name} cannot be read ({kind}: {problem}): nothing to compare with")
        return None


def changes(before: CalibrationValues | None, now: CalibrationValues) -> Row:
    """Return the columns for the values `before`, the values `now`, and their changes.

    The changes are stated in units of u (`change_in_u`): both results are from the same readings, so that a
    change is no random deviation. Without `before`, only the values `now` are returned. If the two results
    are in different signal units, the changes are omitted.
    """
    row = _columns(now, "")
    if before is None:
        return row
    row |= {**_columns(before, "_stored"), "fit_differs": before.fit != now.fit}
    if before.unit != now.unit:
        return row
    change = change_in_u(before, now)
    known = (None if isnan(x) else x for x in change.tolist())
    row |= {f"{name}_change_in_u": x for name, x in zip(COEFFICIENTS, known, strict=True)}
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


def change_in_u(before: CalibrationValues, now: CalibrationValues) -> Floats:
    """Return the change of each coefficient (12,) divided by its earlier u, or by its new u if it had none.

    A coefficient fixed by convention has no u. Without any u, the result is 0 if the coefficient is unchanged, else
    NaN.
    """
    moved = now.values - before.values
    unit = np.where(before.u > 0, before.u, now.u)
    with np.errstate(divide="ignore", invalid="ignore"):
        change: Floats = np.where(unit > 0, moved / unit, np.where(moved == 0, 0.0, np.nan))
    return change


def _columns(found: CalibrationValues, suffix: str) -> Row:
    return {
        f"estimator{suffix}": found.estimator,
        f"model{suffix}": found.model,
        f"signal_unit{suffix}": found.unit,
        f"g{suffix}_m_s2": found.g_m_s2,
        f"fit{suffix}": found.fit,
        f"p{suffix}": found.p,
        **{f"{name}{suffix}": x for name, x in zip(COEFFICIENTS, found.values.tolist(), strict=True)},
        **{
            f"u_{name}{suffix}": None if isnan(x) else x
            for name, x in zip(COEFFICIENTS, found.u.tolist(), strict=True)
        },
    }
