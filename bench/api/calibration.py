"""From readings to coefficients, and to a verdict at the verification points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.analysis.calibration import Calibration, CalibrationError, Verification, implausible
from bench.analysis.calibration import calibrate as estimate
from bench.analysis.calibration import verify as check
from bench.analysis.calibration.estimators import CLOSED_FORM, GLS
from bench.analysis.calibration.verification import COVERAGE_FACTOR, GUARDED, SIMPLE
from bench.analysis.temperature.plateaus import separate_temperatures
from bench.api.coefficients import Coefficients, read_coefficients
from bench.api.errors import Refused
from bench.api.provenance import provenance, record_head
from bench.api.source import Source
from bench.base.arrays import Floats
from bench.base.numbers import fixed, places
from bench.base.tables import as_html, as_text, table
from bench.base.whole import write_whole
from bench.model.block import COEFFICIENTS

LACK_OF_FIT_P = 0.01
SEVERAL_TEMPERATURES = 3


@dataclass(frozen=True)
class Coefficient:
    """One of the twelve, with its standard uncertainty; both in `unit` (such as V/g, of a bias V)."""

    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class CalibrationResult:
    """The twelve coefficients of U = K a + U0 with their covariance, and what they were made from.

    a is the specific force in g of the place (+1 g on an upward axis). `calibration` holds all that was found,
    `source` the readings, the bench and the model.
    """

    source: Source
    calibration: Calibration

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """The twelve by name: "Kxx", "Kxy", … "Kzz" in unit/g, "U0x", "U0y", "U0z" in the unit of the signals."""
        found = self.calibration
        sizes = zip(COEFFICIENTS, found.block.vector.tolist(), found.u.tolist(), strict=True)
        return {name: Coefficient(value, u, coefficient_unit(name, found.unit)) for name, value, u in sizes}

    @property
    def covariance(self) -> Floats:
        """Covariance of the coefficients, shape (12, 12), in the order of `coefficients`."""
        return self.calibration.covariance

    @property
    def bench(self) -> str:
        """Which bench file gave the errors of the stand and, where nobody said it, gravity; and why that one."""
        return self.source.taken.words

    @property
    def g_m_s2(self) -> float:
        """Local gravity, m/s²: the unit of acceleration in the result."""
        return self.calibration.g_m_s2

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Where the block found is not the block announced."""
        return implausible(self.calibration, self.source.bench.unit_under_test.scale_factors.values)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the result should know, a sentence each; rows that were left out, too."""
        readings = self.source.readings
        return (*self.doubts, *self.calibration.notes, *readings.notes, *readings.skipped)

    @property
    def accepted(self) -> bool:
        """Whether the model fits the readings (p of lack of fit not below 0.01) and the block is no other."""
        return not self.doubts and not self.calibration.lack_of_fit.p < LACK_OF_FIT_P

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench calibrate --json` writes it."""
        source = self.source
        unit = source.bench.unit_under_test
        return {
            **self.calibration.to_json(),
            "source": source.name,
            "bench": source.taken.to_dict(),
            "made_at": source.made_at,
            "unit_under_test": {"type": unit.type, "serial": unit.serial} if source.block_name else None,
            "simulated": source.simulated,
            "corrections": source.traced.to_json(),
            **({} if source.run is None else {"record": record_head(source.run)}),
            "notes": [*self.doubts, *self.calibration.notes, *source.readings.notes],
            "skipped_rows": list(source.readings.skipped),
        }

    def report(self, path: str | Path) -> None:
        """Write the page (HTML, with everything in it). Raises `OSError`."""
        write_whole(Path(path), report_page(self)[0])

    def table(self) -> Table:
        """Return the coefficients with u and U (k = 2), rounded to two digits of u."""
        shown = table("coefficient", ">value", ">u", ">U (k=2)", "")
        for name, (value, u, unit) in ((n, (c.value, c.u, c.unit)) for n, c in self.coefficients.items()):
            if value == 0.0 and u == 0.0:
                shown.add_row(name, "0", "", "", "by convention")
                continue
            digits = places(u)
            shown.add_row(name, fixed(value, digits), fixed(u, digits), fixed(2 * u, digits), unit)
        return shown

    def headline(self) -> str:
        """Return a sentence on what was calibrated, and how."""
        found = self.calibration
        readings = f"{len(found.fitted)} readings"
        if found.free is not None:
            readings += f", {len(found.free)} by their modulus"
        if found.skipped:
            readings += f", {found.skipped} bad rows skipped"
        return (
            f"Calibration of {self.source.name}: {found.estimator}, model {found.model}, {readings}, "
            f"local g = {found.g_m_s2:.6g} m/s²"
        )

    def _below(self) -> list[str]:
        return [f"bench: {self.bench}", *(f"note: {note}" for note in self.notes)]

    def __repr__(self) -> str:
        """Return the result as a table with what a reader should know."""

        def print_on(out: Console) -> None:
            out.print(self.headline())
            out.print(self.table())
            for line in self._below():
                out.print(line)

        return as_text(print_on)

    def _repr_html_(self) -> str:
        return as_html([self.headline()], self.table()) + as_html(self._below())


def coefficient_unit(name: str, unit: str) -> str:
    """Return the unit of a coefficient for signals in `unit`."""
    return unit if name.startswith("U0") else f"{unit}/g"


def calibration_of(
    source: Source,
    estimator: str = GLS,
    *,
    nominal_angles: bool = False,
    join_free: bool = True,
    join_verification: bool = False,
) -> CalibrationResult:
    """Calibrate a source with its own bench and model. Raises `CalibrationError` where it cannot be."""
    source = _with_note_on_temperatures(source)
    found = estimate(
        source.readings,
        source.model,
        source.stand_u,
        source.g_m_s2,
        estimator,
        nominal_angles=nominal_angles,
        join_free=join_free,
        join_verification=join_verification,
    )
    return CalibrationResult(source, found)


def _with_note_on_temperatures(source: Source) -> Source:
    """Note where the readings are at several temperatures, of which one calibration makes a mixture."""
    found = separate_temperatures(source.readings)
    if len(found) < SEVERAL_TEMPERATURES:
        return source
    note = (
        f"readings span {found[-1] - found[0]:.0f} K at {len(found)} temperatures, and these coefficients mix "
        "them: see bench compensate"
    )
    return replace(source, readings=replace(source.readings, notes=(*source.readings.notes, note)))


# --- verification -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class VerificationResult:
    """Δg at the verification points of a source against the limit; `warnings` are on the coefficients taken."""

    source: Source
    verification: Verification
    warnings: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every verification point was measured and passed."""
        return self.verification.passed

    @property
    def otherwise(self) -> bool:
        """Whether it is judged by another rule than a run's own verdict is, or another limit."""
        own = SIMPLE, self.source.bench.verification_limit_g
        return (self.verification.rule, self.verification.limit_g) != own

    @property
    def bench(self) -> str:
        """Which bench file gave the limit, the errors of the stand and gravity; and why that one."""
        return self.source.taken.words

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the result should know, a sentence each."""
        return (*self.source.readings.notes, *self.source.readings.skipped)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench verify --json` writes it."""
        return {
            **self.verification.to_json(),
            "bench": self.source.taken.to_dict(),
            "corrections": self.source.traced.to_json(),
        }

    def table(self) -> Table:
        """Return Δg at each verification point."""
        result = self.verification
        guarded = [">accepted up to"] if result.rule == GUARDED else []
        shown = table("verification point", ">angle", ">Δg", ">u", *guarded, "")
        for p in result.points:
            limit = f"{p.accepted_up_to * 1e6:.1f} µg" if p.accepted_up_to > 0 else "nothing"
            shown.add_row(
                f"pass {p.pass_number} point {p.point}",
                f"{p.angle_deg:.4f}°",
                f"{p.delta_g * 1e6:+.1f} µg",
                f"{p.u * 1e6:.1f} µg",
                *([limit] if guarded else []),
                "within"
                if p.passed
                else "in the guard band"
                if abs(p.delta_g) <= result.limit_g
                else "OUTSIDE",
            )
        return shown

    def verdict(self) -> str:
        """Return the verdict in one line."""
        return verdict_line(self.source.name, self.verification)

    def __repr__(self) -> str:
        """Return the points and the verdict."""

        def print_on(out: Console) -> None:
            out.print(self.table())
            for line in self._below():
                out.print(line)

        return as_text(print_on)

    def _below(self) -> list[str]:
        notes = (*self.warnings, *self.notes)
        return [f"bench: {self.bench}", *(f"note: {note}" for note in notes), self.verdict()]

    def _repr_html_(self) -> str:
        return as_html([], self.table()) + as_html(self._below())


def verdict_line(name: str, result: Verification) -> str:
    """Return the verdict on what is called `name` in one line."""
    worst = max(result.points, key=lambda p: abs(p.delta_g))
    missing = f"; {result.missing} verification points are missing" if result.missing else ""
    rule = result.rule + (
        f" (U, k = {COVERAGE_FACTOR:g}, taken off the limit)" if result.rule == GUARDED else ""
    )
    return (
        f"{name}: {'PASSED' if result.passed else 'FAILED'}: worst |Δg| = {abs(worst.delta_g) * 1e6:.1f} µg "
        f"± {worst.u * 1e6:.1f} µg (u), limit {result.limit_g * 1e6:.0f} µg, rule: {rule}{missing}"
    )


def check_limit(limit_g: float | None) -> None:
    """Refuse a limit of |Δg| that is none. Raises `Refused`."""
    if limit_g is not None and not (math.isfinite(limit_g) and limit_g > 0):
        raise Refused(f"--limit {limit_g}: a limit is a positive number of g, such as 3e-4")


def verification_of(
    source: Source,
    coefficients: Path | CalibrationResult | None = None,
    limit_g: float | None = None,
    rule: str = SIMPLE,
) -> VerificationResult:
    """Verify a source with coefficients of a file, of a calibration at hand, or of its own readings."""
    warnings: tuple[str, ...] = ()
    if coefficients is None:
        coefficients = calibration_of(source)
        source = coefficients.source
    if isinstance(coefficients, CalibrationResult):
        own = coefficients.calibration
        if own.unit != source.readings.unit:
            raise Refused(f"coefficients in {own.unit}/g, but the readings are in {source.readings.unit}")
        taken = Coefficients(own.block, own.covariance, own.noise.reading, own.g_m_s2, own.unit)
    else:
        taken = read_coefficients(coefficients, source.readings.unit)
        if taken.simulated and not source.simulated:
            warnings = (f"the coefficients in {coefficients} were found on simulated instruments",)
    limit = source.bench.verification_limit_g if limit_g is None else limit_g
    ratio = taken.g_m_s2 / source.g_m_s2
    verdict = check(source.readings, taken.block, taken.covariance, taken.noise, limit, ratio, rule)
    return VerificationResult(source, verdict, warnings)


# --- report -----------------------------------------------------------------------------------------


def report_page(result: CalibrationResult) -> tuple[str, VerificationResult | None]:
    """Verify, where there are verification points; return the page (HTML) and the verification in it."""
    from bench.report import ReportContent, render_report

    source = result.source
    verdict = verification_of(source, result) if len(source.readings.verification()) else None
    content = ReportContent(
        title=f"Calibration of {source.block_name or source.name}",
        calibration=result.calibration,
        verification=None if verdict is None else verdict.verification,
        compared=_closed_form(source),
        provenance=provenance(source),
        notes=(*result.doubts, *result.calibration.notes, *source.readings.notes),
        skipped=source.readings.skipped,
        simulated=source.simulated,
    )
    return render_report(content), verdict


def _closed_form(source: Source) -> Calibration | None:
    """The paper's estimator beside ours, where the readings are such that it applies."""
    try:
        return calibration_of(source, CLOSED_FORM).calibration
    except CalibrationError:
        return None
