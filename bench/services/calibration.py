"""Calibrations from readings: with a prior, with verification, and as a report page."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich.console import Console

from bench.base.arrays import Floats
from bench.base.files import write_whole
from bench.base.languages import message
from bench.base.tables import as_html, as_text
from bench.base.text import listed
from bench.calibration.budget.whole import sign
from bench.calibration.calibrate import calibrate as estimate
from bench.calibration.estimators import CLOSED_FORM, GLS
from bench.calibration.intrinsic import Intrinsic, intrinsic_of
from bench.calibration.mistakes import implausible, refuse_mixed_units, sheet_of
from bench.calibration.result import COVERAGE_FACTOR, Calibration, CalibrationError
from bench.calibration.temperature import PLATEAU_K, separate_temperatures
from bench.config.bench_file.learned import PriorFile, load_prior
from bench.model.conditions import REFERENCE_C
from bench.model.effects import TEMPERATURE_EFFECTS, with_temperature
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings.corrected import VOLTS
from bench.readings.table import VERIFICATION, is_record
from bench.results.calibration import (
    PriorPart,
    calibrate_result,
    coefficients_table,
    headline,
    print_calibration,
)
from bench.results.parts import coefficient_unit, named
from bench.run.events import writing
from bench.services.errors import Refused
from bench.services.own_effects import knowing_effects_of
from bench.services.source import Source, provenance

if TYPE_CHECKING:
    from bench.calibration.conformity import DecisionRule
    from bench.exchange.result import BlockResult
    from bench.history.prior import Prior
    from bench.services.coefficients import Coefficients
    from bench.services.requests.evaluation import Calibrate, Verify
    from bench.services.stability import RecordCalibrationResult
    from bench.services.verification import VerdictOptions, VerificationResult

SEVERAL_TEMPERATURES: Final = 3
"""From this number on, plateaus are separate temperatures; two may be a drift across one limit of a plateau."""
APART_K: Final = 2 * PLATEAU_K
"""Mean temperatures of two plateaus that differ by more than this are of no such drift."""


def read_prior(path: Path) -> Prior:
    """Read a prior file. Raises `FileMistakes`, and `Refused` if its scale factors are not per standard gravity."""
    from bench.history.measured import STANDARD_GRAVITY
    from bench.history.prior import Prior

    file: PriorFile = load_prior(path)
    if file.per_g_m_s2 != STANDARD_GRAVITY:
        raise Refused(
            f"{path}: per_g_m_s2 is {file.per_g_m_s2:g}, expected {STANDARD_GRAVITY}; make the file again with "
            "'bench fleet prior'"
        )
    rows = [file.coefficients[name] for name in COEFFICIENTS]
    return Prior(
        kind=file.type,
        mean=np.array([row.mean for row in rows]),
        covariance=np.array(file.covariance),
        between=np.array([row.between_units for row in rows]),
        mean_u=np.array([row.u_mean for row in rows]),
        **file.model_dump(exclude={"type", "per_g_m_s2", "coefficients", "covariance"}),
    )


def with_prior(
    found: Calibration, source: Source, path: Path
) -> tuple[Calibration, PriorPart, tuple[str, ...]]:
    """Combine a calibration with the prior file `path`; return the calibration, the part on the prior, and notes.

    If readings and prior contradict each other, the calibration is returned unchanged, with a note. Raises
    `Refused` for a prior that does not apply to these readings, such as that of another type of unit.
    """
    from bench.history.prior import CONFLICT_P, join

    prior = read_prior(path)
    _refuse_other(prior, found, source, path)
    alike = found.covariance - found.covariance_readings
    joined = join(found.block.vector, found.covariance_readings, alike, prior, found.g_m_s2, found.gravity_u)
    notes = []
    if not source.bench.unit_under_test.serial:
        notes.append(
            "the unit of these readings was not recorded; it is assumed to be none of the "
            f"{len(prior.units)} units behind {path}"
        )
    if joined.used:
        notes.append(
            f"prior of type {prior.kind} ({len(prior.units)} units, {path}) is used with the readings: they agree "
            f"(p = {joined.p:.2g}); residuals and noise are those of the readings alone"
        )
    else:
        worst = np.argsort(-np.abs(joined.pull))[:3]
        off = ", ".join(f"{COEFFICIENTS[k]} by {joined.pull[k]:+.1f} u" for k in worst)
        notes.append(
            f"prior of type {prior.kind} NOT USED: it contradicts the readings (p = {joined.p:.1g}, below "
            f"{CONFLICT_P:g}; {off}); check unit, mounting and type"
        )
    part = PriorPart.from_object(
        joined,
        file=str(path),
        type=prior.kind,
        units=len(prior.units),
        dof=prior.dof,
        pull=named(joined.pull),
        u_without=named(found.u),
    )
    if not joined.used:
        return found, part, tuple(notes)
    changed = replace(
        found,
        block=Block.from_vector(joined.vector),
        covariance=joined.covariance,
        covariance_readings=joined.covariance - alike,
        gain=np.tensordot(np.eye(len(COEFFICIENTS)) - joined.part, found.gain, axes=1),
    )
    return changed, part, tuple(notes)


def _refuse_other(prior: Prior, found: Calibration, source: Source, path: Path) -> None:
    unit = source.bench.unit_under_test
    name = " ".join(filter(None, (unit.type, unit.serial)))
    if found.triangular is not None:
        raise Refused(
            "--prior: free positions alone leave the block's orientation open; add oriented readings"
        )
    if (unit.type or "") != prior.kind:
        raise Refused(
            f"{path}: the prior is for units of type {prior.kind!r}, but this unit is of type "
            f"{(unit.type or 'unknown')!r}; give a prior for its type"
        )
    if found.unit != prior.signal:
        raise Refused(
            f"{path}: the prior is in {prior.signal}/g, but the readings are in {found.unit}; give a prior made "
            f"from calibrations in {found.unit}/g"
        )
    if source.simulated != prior.simulated:
        its, here = ("simulated", "real") if prior.simulated else ("real", "simulated")
        raise Refused(
            f"{path}: the prior was made from {its} calibrations, but this run is {here}; give a prior "
            f"made from {here} calibrations"
        )
    if unit.serial and name in prior.units:
        raise Refused(
            f"{path}: the prior includes {name} itself, which would count twice; make a prior without this unit: "
            f"bench fleet prior 'type={prior.kind}' 'unit!={name}' --prior-out FILE"
        )


@dataclass(frozen=True)
class Coefficient:
    """A coefficient in `unit` (such as V/g; V for a bias) with its combined standard uncertainty `u`.

    `u_readings` is the part of u from the readings and the stated limits of the stand. `u` and `u_readings` are
    NaN for a coefficient that free positions alone do not determine and that is therefore zero by convention.
    `dof` are the effective degrees of freedom of u. u is already widened for a small `dof`: `U` is always `k` u.
    """

    value: float
    u: float
    unit: str
    u_readings: float
    dof: float
    k: float = COVERAGE_FACTOR

    @property
    def U(self) -> float:  # noqa: N802 - the symbol of the field
        """Expanded uncertainty k u."""
        return self.k * self.u


@dataclass(frozen=True)
class CalibrationResult:
    """The twelve coefficients of U = K a + U0 with their covariance, and the data behind them.

    a is the specific force in local g (+1 g on an axis that points upward). `calibration` is the complete
    estimate, `source` the readings with bench and model. `prior` is the result's part on the prior file, None
    without one; `of_prior` are notes on that file.
    """

    source: Source
    calibration: Calibration
    prior: PriorPart | None = None
    of_prior: tuple[str, ...] = ()

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """The coefficients by name: "Kxx", "Kxy", … "Kzz" in unit/g; "U0x", "U0y", "U0z" in the signals' unit."""
        found = self.calibration
        u, of_readings = found.determined(found.u), found.determined(found.u_readings)
        columns = (found.block.vector, u, of_readings, found.dof)
        rows = zip(COEFFICIENTS, *(column.tolist() for column in columns), strict=True)
        return {
            name: Coefficient(value, u, coefficient_unit(name, found.unit), own, dof)
            for name, value, u, own, dof in rows
        }

    @cached_property
    def intrinsic(self) -> Intrinsic | None:
        """The nine intrinsic numbers, with `values`, `u`, `U` and `covariance` (9, 9).

        None if a row of K is zero, or if two rows are parallel.
        """
        return intrinsic_of(self.calibration)

    @property
    def covariance(self) -> Floats:
        """Combined covariance of the coefficients, shape (12, 12), in the order of `coefficients`."""
        return self.calibration.covariance

    def as_coefficients(self) -> Coefficients:
        """Return the coefficients as `read_coefficients` would return them from the result file."""
        from bench.services.coefficients import Coefficients, widened_noise

        own, corrected = self.calibration, not set(TEMPERATURE_EFFECTS).isdisjoint(self._temperature_effects)
        return Coefficients(
            own.block, own.covariance, own.noise.reading, own.g_m_s2, own.unit, self.source.simulated,
            own.covariance_same_meters if own.sources else None, self.source.meters, own.gravity_u,
            self.source.made_at or "", own.block_terms if own.sources else None, own.wander,
            self.source.block_name, math.nan if corrected else self.temperature_c, self.accepted,
            self.joined_points, widened_noise(own.noise.by_channel, own.noise.setting_rad, own.noise.dof),
            own.shared,
        )  # fmt: skip

    @property
    def temperature_c(self) -> float:
        """Mean temperature of the block in the fitted readings, °C; NaN if it is unknown."""
        known = self.calibration.temperatures_c
        return float(np.mean(known)) if len(known) else math.nan

    @property
    def holds_at_c(self) -> float:
        """Temperature of the block at which the coefficients hold, °C; NaN if it is unknown.

        With an effect of temperature it is the reference. Coefficients that the effect does not change then still
        hold at `temperature_c`.
        """
        return REFERENCE_C if self._of_temperature[1] else self.temperature_c

    @property
    def _of_temperature(self) -> tuple[list[str], bool]:
        return with_temperature(one.effect for one in self.source.model.effects)

    @property
    def _temperature_effects(self) -> list[str]:
        return self._of_temperature[0]

    @property
    def joined_points(self) -> str:
        """The name of the source if its verification points joined the fit, else ""."""
        free = self.calibration.free
        return self.source.name if free is not None and VERIFICATION in free.installation else ""

    @property
    def bench(self) -> str:
        """The name of the bench file that states gravity and the errors of the stand, and why it was chosen."""
        return self.source.taken.words

    @property
    def g_m_s2(self) -> float:
        """Local gravity, m/s²: the unit of acceleration in the result."""
        return self.calibration.g_m_s2

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Warnings, a sentence each, on scale factors that contradict the block's nominal scale factors."""
        return implausible(self.calibration, self.source.bench.unit_under_test.scale_factors.values)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader of the result, a sentence each, with one for each skipped row."""
        readings = self.source.readings
        return (*self._said, *readings.notes, *readings.skipped)

    @property
    def _said(self) -> tuple[str, ...]:
        fit = self.calibration.lack_of_fit.diagnose(self.source.typed)
        names, at_reference = self._of_temperature
        at = (
            message(
                f"coefficients corrected by {listed(names)} hold at {REFERENCE_C:g} °C, the others at the mean "
                "temperature of the readings"
            ),
        )
        return (*fit, *self.doubts, *(at if at_reference else ()), *self.of_prior, *self.calibration.notes)

    @property
    def accepted(self) -> bool:
        """Whether p of the lack-of-fit test is unknown or at least 1e-4, or residuals are mere rounding."""
        return self.calibration.lack_of_fit.accepted()

    @property
    def strictly_accepted(self) -> bool:
        """Whether there are no `doubts`, and `accepted` is also true with 0.01 in place of 1e-4."""
        return not self.doubts and self.calibration.lack_of_fit.accepted(strict=True)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench calibrate --json` writes it."""
        source = self.source
        return calibrate_result(
            self.calibration,
            **source.made_from(),
            **({} if source.run is None else {"record": source.run.record_head}),
            **({} if self.prior is None else {"prior": self.prior}),
            temperature_effects=self._temperature_effects,
            meters=source.meters,
            temperature_c=self.temperature_c,
            holds_at_c=self.holds_at_c,
            notes=[*self._said, *source.readings.notes],
            skipped_rows=source.readings.skipped,
        ).to_dict()

    def report(self, path: str | Path) -> None:
        """Write the report as one self-contained HTML page. Raises `RecordError`."""
        with writing(path) as file:
            write_whole(file, report_page(self)[0])

    @cached_property
    def derived(self) -> BlockResult:
        """N = K^-1 and the misalignment angles (`inverse`, `misalignments`), each with its covariance."""
        from bench.services.coefficients import block_result

        return block_result(self.to_dict(), self.source.name)

    def write(
        self,
        path: str | Path,
        form: str,
        *,
        nominal: tuple[float, float, float] | None = None,
        without_temperature: bool = False,
    ) -> tuple[str, ...]:
        """Write the coefficients as `bench coefficients --as FORM` does; return what the form cannot hold.

        `form` is "json", "csv", "c", "excel", "kalibr", "px4" or "ardupilot". The last three are for signals
        in m/s^2; `nominal` are the scale factors (unit/g) by which the signals were converted. No form can
        hold a correction for temperature: a calibration with such a correction is written only if
        `without_temperature` is true. Raises `Refused` for any other form, and `RecordError`.
        """
        from bench.services.coefficients import write_form

        with writing(path) as file:
            return write_form(self.derived, file, form, nominal, without_temperature=without_temperature)

    def print_on(self, out: Console) -> None:
        """Print the coefficients, the noise, the fit, and the notes."""
        print_calibration(self.source.name, self.calibration, self.notes, out)

    def __repr__(self) -> str:
        """Return the coefficients as a table, with the notes."""

        def print_on(out: Console) -> None:
            out.print(headline(self.source.name, self.calibration))
            out.print(coefficients_table(self.calibration))
            for line in self._below():
                out.print(line)

        return as_text(print_on)

    def _repr_html_(self) -> str:
        head = headline(self.source.name, self.calibration)
        return as_html([head], coefficients_table(self.calibration)) + as_html(self._below())

    def _below(self) -> list[str]:
        return [f"bench: {self.bench}", *(f"note: {note}" for note in self.notes)]


def calibration_of(
    source: Source,
    estimator: str = GLS,
    *,
    nominal_angles: bool = False,
    join_free: bool = True,
    join_verification: bool = False,
    prior: Path | None = None,
) -> CalibrationResult:
    """Calibrate a source with its bench and model.

    `prior` is a prior file for units of the source's type. Other options are those of `estimate`. Raises
    `CalibrationError` if the readings allow no calibration, `Refused` for a prior that does not apply.
    """
    source = _with_note_on_temperatures(source)
    sheet = sheet_of(source.readings.unit, source.bench.unit_under_test.scale_factors.values)
    refuse_mixed_units(source.readings, source.model, sheet)
    found = estimate(
        source.readings,
        source.model,
        source.stand_u,
        source.g_m_s2,
        estimator,
        assumed_u=source.assumed_u,
        nominal_angles=nominal_angles,
        join_free=join_free,
        join_verification=join_verification,
        known=source.known,
        nominal=source.bench.unit_under_test.scale_factors.values if source.readings.unit == VOLTS else None,
    )
    signed = sign(found, source.readings, source.bench, source.model, source.traced.day, source.known_meters)
    if prior is None:
        return CalibrationResult(source, signed)
    return CalibrationResult(source, *with_prior(signed, source, prior))


def result_of(source: Source) -> CalibrationResult | RecordCalibrationResult:
    """Calibrate a block or, for a record at a known input, its meters. Raises the errors of `calibration_of`."""
    if not is_record(source.readings):
        return calibration_of(source)
    from bench.services.stability import record_calibration_of  # takes long to import

    return record_calibration_of(source)


def calibrated(request: Calibrate, source: Source) -> CalibrationResult | RecordCalibrationResult:
    """Return the calibration of a source with the options of a request. Raises the errors of `calibration_of`."""
    if is_record(source.readings):
        if request.otherwise:
            raise Refused(
                f"{source.name}: options on the fit of a block do not apply to a record at a known input; "
                "leave out --estimator, --prior, --nominal-angles and --join-…"
            )
        return result_of(source)
    return calibration_of(
        source,
        request.estimator,
        nominal_angles=request.nominal_angles,
        join_free=request.join_free,
        join_verification=request.join_verification,
        prior=None if request.prior is None else Path(request.prior),
    )


def _with_note_on_temperatures(source: Source) -> Source:
    """Return the source, with a note if its readings are at several temperatures, which a fit mixes."""
    found = separate_temperatures(source.readings)
    if not found or (len(found) < SEVERAL_TEMPERATURES and found[-1] - found[0] <= APART_K):
        return source
    note = message(
        f"readings span {found[-1] - found[0]:.0f} K at {len(found)} temperatures, and these coefficients "
        "mix them; use 'bench compensate'"
    )
    return replace(source, readings=replace(source.readings, notes=(*source.readings.notes, note)))


# --- verification and report of a calibration --------------------------------------------------------


def verification_of(
    source: Source,
    coefficients: Path | CalibrationResult | None = None,
    asked: VerdictOptions | None = None,
    agreed: DecisionRule | None = None,
) -> VerificationResult:
    """Verify a source with coefficients from a file, from a calibration, or (None) from these same readings.

    The options `asked` replace those of run and bench file. The decision rule is `agreed` if neither options, run
    nor bench file name one. Raises `Refused` for unsuitable options or coefficients, `CalibrationError`.
    """
    from bench.services.verification import judged, own_judgement, unsuitable  # takes long to import

    judgement = own_judgement(source, asked, agreed)
    if coefficients is None:
        coefficients = calibration_of(source)
        source = coefficients.source
    if isinstance(coefficients, Path):
        from bench.services.coefficients import read_coefficients

        taken, name = read_coefficients(coefficients, source.readings.unit), str(coefficients)
    else:
        taken, name = coefficients.as_coefficients(), coefficients.source.name
        if taken.unit != source.readings.unit:
            raise Refused(
                f"the coefficients are in {taken.unit}/g, but the readings in {source.readings.unit}; give the "
                f"coefficients of a calibration in {source.readings.unit}/g"
            )
        if coefficients.source is source:
            return judged(source, judgement, taken, coefficients.calibration)
    return judged(source, judgement, taken, warnings=tuple(unsuitable(taken, name, source)))


def verified(request: Verify, source: Source) -> VerificationResult:
    """Return the verification of a source with the options of a request. Raises the errors of `verification_of`."""
    from bench.services.verification import VerdictOptions

    given = request.coefficients
    if given is not None and not isinstance(given, CalibrationResult):
        given = Path(str(given))
    return verification_of(source, given, VerdictOptions.of(request))


def report_page(
    result: CalibrationResult | RecordCalibrationResult, asked: VerdictOptions | None = None
) -> tuple[str, VerificationResult | None]:
    """Return the report as HTML, and the verification in it. Raises `Refused`.

    The verification is None if there are no verification points, or if they joined the fit.
    """
    if not isinstance(result, CalibrationResult):
        from bench.services.verification import NOTHING_ASKED

        if asked not in (None, NOTHING_ASKED):
            raise Refused(
                f"{result.source.name}: a record at a known input has no |a| to judge; leave out the options of "
                "the verdict"
            )
        return result.html(), None
    from bench.results.page import render_report  # matplotlib is slow to import

    source = result.source
    # points that joined the fit cannot verify it
    judged = len(source.readings.verification()) > 0 and not result.joined_points
    verdict = verification_of(source, result, asked) if judged else None
    with knowing_effects_of(source):
        page = render_report(
            message(f"Calibration of {source.block_name or source.name}"),
            result.calibration,
            None if verdict is None else verdict.verification,
            compared=_closed_form(source),
            provenance=provenance(source),
            notes=(*result.calibration.notes, *source.readings.notes),
            skipped=source.readings.skipped,
            simulated=source.simulated,
            warnings=result.doubts if verdict is None else verdict.warnings,
        )
    return page, verdict


def _closed_form(source: Source) -> Calibration | None:
    try:
        return calibration_of(source, CLOSED_FORM).calibration
    except CalibrationError:
        return None
