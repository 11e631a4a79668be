"""Compile a certificate from a run, a laboratory file and an order file; list the missing information."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats, u_of
from bench.base.files import to_text
from bench.base.languages import message
from bench.base.text import as_typed, visible
from bench.calibration.budget.sources import hidden_sources
from bench.calibration.budget.whole import dof_through
from bench.calibration.conformity import DecisionRule
from bench.certificate.content import (
    Certificate,
    Condition,
    Contribution,
    Instrument,
    Issue,
    Item,
    Method,
    RunFindings,
    RunReference,
    Value,
    Values,
)
from bench.certificate.laboratory import Laboratory, Order, Texts, texts_of
from bench.exchange.result import ReportedNumbers
from bench.model.geometry import COEFFICIENTS
from bench.readings.columns import current_column, numbers, rails_of, voltage_column
from bench.readings.csv import format_csv
from bench.readings.table import CHAMBER_C, FREE, TEMPERATURE_SOURCE, VERIFICATION
from bench.results.parts import coefficient_unit
from bench.results.verification import global_risk_in_words
from bench.run.events import ENDED
from bench.run.folder import IMPORTED, Run
from bench.run.seal import read_seal, seal_of
from bench.services.bench_selection import origin_beside
from bench.services.calibration import CalibrationResult, calibration_of, verification_of
from bench.services.errors import Refused
from bench.services.source import Request, Source, load_sources
from bench.services.verification import NOTHING_ASKED, VerdictOptions, VerificationResult, overruled_in

_FIRST_LANGUAGE: Final = "en"


def certificate_of(
    run: str,
    runs: Path,
    laboratory: Laboratory | None = None,
    order: Order | None = None,
    issue: Issue | None = None,
) -> Certificate:
    """Evaluate a run with its recorded settings; return its certificate.

    Raises `Refused` for a missing or unfinished run, `RecordError` for a damaged record, and
    `CalibrationError` if the readings do not determine a result.
    """
    k = 2.0 if laboratory is None else laboratory.k
    asked = NOTHING_ASKED if order is None else VerdictOptions(rule=order.rule, guard_band=order.guard_band)
    agreed = None
    if laboratory is not None and laboratory.names_a_rule:
        agreed = DecisionRule.of(laboratory.rule, laboratory.guard_band)
    found_of = partial(found_by, runs=runs, k=k, asked=asked, agreed=agreed)
    found = found_of(run)
    unit = None if order is None else order.unit(found.item.serial)
    adjusted = None if unit is None else unit.adjusted
    before = None
    if adjusted is not None and adjusted.as_found is not None:
        before = found_of(adjusted.as_found)
        if before.item != found.item:
            raise Refused(
                f"{run}: the run as found, {adjusted.as_found}, is of unit {before.item.type} "
                f"{before.item.serial}; write a run of this unit as 'as_found' under 'adjusted'"
            )
    return Certificate(found, texts_for(laboratory), laboratory, order, unit, before, issue)


def texts_for(laboratory: Laboratory | None) -> tuple[Texts, ...]:
    """Return the certificate's texts in each language of the laboratory, by default in English."""
    if laboratory is None:
        return (texts_of(_FIRST_LANGUAGE),)
    return tuple(
        Texts(name, {**texts_of(name).entries, **laboratory.texts.get(name, {})})
        for name in laboratory.language
    )


def missing(certificate: Certificate) -> tuple[str, ...]:
    """Return a sentence for each item required by ISO/IEC 17025:2017, 7.8 that is missing or invalid."""
    return tuple(_missing(certificate))


def _missing(certificate: Certificate) -> Iterator[str]:
    found, order, unit = certificate.found, certificate.order, certificate.unit
    if certificate.laboratory is None:
        yield message("the laboratory, its address and place (7.8.2.1 b, c): --laboratory FILE")
    if order is None:
        yield message("the customer, receipt and condition of the unit (7.8.2.1 e, g, h): --order FILE")
    elif unit is None:
        yield message(
            f"unit {found.item.serial!r} in the order file (7.8.2.1 g, h): its receipt, condition and state"
        )
    if not found.item.serial:
        yield message("the serial number of the unit (7.8.2.1 g): missing in the record")
    if not any(one.key == "temperature" for one in found.conditions):
        yield message("the temperature during the calibration (7.8.4.1 b): missing in every reading")
    if (
        (names := certificate.uncertified)
        and not found.simulated
        and (order is None or order.without_certificates is None)
    ):
        yield message(
            f"the traceability of {', '.join(names)} (7.8.4.1 c): state certificates that are valid "
            "on the day of the run in the bench file before it, or the agreement as "
            "'without_certificates' in the order file"
        )
    yield from _missing_before(certificate)
    yield from _accreditation_ended(certificate)
    if doubts := found.result.doubts:
        yield message(
            f"agreement with the data sheet: {'; '.join(doubts)}; correct wiring or labels and measure again; if "
            "'scale_factors' of the bench file are wrong, correct them, 'bench export' the readings and 'bench "
            "import' them with this bench file"
        )
    calibrated = certificate.calibrated
    if calibrated is None:
        yield message(
            "the days of the calibration (7.8.2.1 i): missing in the readings; state 'calibrated' for the "
            "unit in the order file"
        )
        return
    begun, ended = calibrated
    if certificate.as_found is not None and certificate.as_found.days is not None:
        begun = min(begun, certificate.as_found.days[0])
    if unit is not None and unit.received > begun + timedelta(days=1):  # a local day can be one ahead of UTC
        yield message(
            f"a day of receipt (7.8.2.1 h) before the calibration: {unit.received} is after {begun}"
        )
    elif certificate.issue is not None and certificate.issue.day < str(ended):
        yield message(
            f"a day of issue (7.8.2.1 j) after the calibration: {certificate.issue.day} is before {ended}"
        )


def _accreditation_ended(certificate: Certificate) -> Iterator[str]:
    issue, house = certificate.issue, certificate.laboratory
    held = None if house is None else house.accreditation
    if issue is None or certificate.simulated or held is None or held.valid_until is None:
        return  # drafts and simulated certificates do not name the accreditation
    if issue.day > str(held.valid_until):
        yield message(
            f"an accreditation valid on the day of issue: {held.number} ended on {held.valid_until}; correct or "
            "remove 'accreditation' in the laboratory file"
        )


def _missing_before(certificate: Certificate) -> Iterator[str]:
    found, before = certificate.found, certificate.as_found
    if before is None:
        return
    what = message(f"results before the adjustment (7.8.4.1 d): the run 'as_found', {before.record.run},")
    if before.record.head == found.record.head:
        yield message(f"{what} is the calibrated run itself")
    elif before.simulated != found.simulated:
        yield message(f"{what} is {'simulated' if before.simulated else 'real'}, the calibrated one is not")
    elif before.days is not None and certificate.calibrated is not None:
        last, first = before.days[1], certificate.calibrated[0]
        if last > first:
            yield message(f"{what} ended on {last}, after the calibration began on {first}")
        elif last == first and found.days is not None:
            ended, begun = (
                datetime.fromisoformat(time).astimezone(UTC) for time in (before.ended, found.begun)
            )
            if ended > begun:
                yield message(
                    f"{what} ended at {ended:%H:%M:%S} on {last}, after the calibration began at "
                    f"{begun:%H:%M:%S} (UTC)"
                )


def found_by(
    name: str, runs: Path, k: float, asked: VerdictOptions = NOTHING_ASKED, agreed: DecisionRule | None = None
) -> RunFindings:
    """Evaluate a run with its own bench file; return the results, with U = `k` u of the coefficients.

    `asked` are the user's options for the verdict. `agreed` is the decision rule if neither `asked` nor the
    record names one. Raises the errors of `certificate_of`.
    """
    (source,) = load_sources(Request([name], runs))
    run = source.run
    if run is None:
        raise Refused(
            f"{name}: a certificate needs a run; 'bench import {as_typed(name)}' makes one from a readings file"
        )
    if not run.imported and run.history.state not in ENDED:
        raise Refused(f"{name}: the run is {run.history.state}; a certificate needs a run that has ended")
    result = calibration_of(source)
    if result.calibration.triangular is not None:
        raise Refused(
            f"{name}: a certificate states twelve coefficients, but free positions alone determine nine; measure "
            "the block in two installations"
        )
    verdict = None
    if len(source.readings.verification()):
        verdict = verification_of(result.source, result, asked, agreed)
    last = run.history.events.last
    # the other notes of a verdict advise the operator and do not belong on a certificate
    of_all = overruled_in(run)
    if verdict is not None:
        of_all += tuple(filter(None, [verdict.verification.contradiction]))
        of_all += global_risk_in_words(verdict.verification)
    record, begun, unit = _record(run), _begun(source), source.bench.unit_under_test
    return RunFindings(
        record=record,
        item=Item(_one_line(unit.type), _one_line(unit.serial)),
        begun=begun,
        ended=begun if begun and run.imported else last.time if last else "",
        operator=_one_line("" if source.origin is None else source.origin.operator),
        method=_method(source, result),
        **_values(result, k),
        conditions=tuple(_conditions(source)),
        instruments=tuple(_instruments(source)),
        contributions=tuple(_contributions(result)),
        result=result,
        verdict=verdict,
        result_json=_result_json(run, result, verdict),
        readings_csv=format_csv(source.as_read),
        notes=tuple(_plain(note, run) for note in (*result.notes, *of_all)),
        simulated=source.simulated,
    )


def _values(result: CalibrationResult, k: float) -> dict[str, Values]:
    own, derived = result.calibration, result.derived

    def values_of(of: ReportedNumbers, dof: Floats) -> Values:
        rows = zip(of.rows, dof.tolist(), strict=True)
        found = (Value(row.name, row.value, row.u, k * row.u, k, nu, row.unit) for row, nu in rows)
        return Values(tuple(found), of.covariance)

    others = {name: getattr(derived, name) for name in ("inverse", "misalignments", "intrinsic")}
    return {
        "coefficients": values_of(derived.coefficients, own.dof),
        **{name: values_of(of, dof_through(own, of.jacobian)) for name, of in others.items()},
    }


def _method(source: Source, result: CalibrationResult) -> Method:
    origin = source.origin
    procedure = "" if origin is None else Path(origin.procedure).name
    plan = "" if origin is None else origin.plan_hash
    return Method(_one_line(procedure), plan, result.calibration.estimator, result.calibration.model)


def _record(run: Run) -> RunReference:
    seal = read_seal(run.folder)
    if seal is not None and (wrong := seal.differences(run)):
        raise Refused(f"{run.name}: no certificate was made: {'; '.join(wrong)}")
    stated = seal_of(run, "") if seal is None else seal
    head = run.record_head
    return RunReference(
        run.name,
        int(head["events"]),
        str(head["head"]),
        to_text(stated.to_json()),
        stated.sealed,
    )


def _begun(source: Source) -> str:
    """Return the time at which the readings began; empty for imported readings that do not state it."""
    run = source.run
    if run is not None and run.imported and origin_beside(run.folder / IMPORTED).origin is None:
        return ""
    return "" if source.origin is None else source.origin.begun


def _conditions(source: Source) -> Iterator[Condition]:
    readings = source.readings
    used = readings.select(readings.is_oriented | np.isin(readings.installation, [VERIFICATION, FREE]))
    told = sorted({text for text in used.extra.get(TEMPERATURE_SOURCE, ()) if text})
    span = _span(used.temperature_c)
    if span is not None:
        of_block, by = _of_temperature(source)
        yield Condition("temperature", *span, "°C", u=of_block, source="; ".join([*told, by]))
    if CHAMBER_C in used.extra and (span := _span(numbers(used.extra[CHAMBER_C]))) is not None:
        yield Condition("chamber", *span, "°C")
    for rail in rails_of(used.extra):
        for key, column, unit in (
            ("supply", voltage_column(rail), "V"), ("current", current_column(rail), "A"),
        ):  # fmt: skip
            if column in used.extra and (span := _span(numbers(used.extra[column]))) is not None:
                yield Condition(key, *span, unit, rail)
    g, u, origin = source.g_m_s2, None, ""
    for error in hidden_sources(source.bench, source.model):
        if error.name == "gravity":
            u, origin = error.u * g, error.origin
    yield Condition("gravity", g, g, "m/s²", u=u, source=origin)


def _of_temperature(source: Source) -> tuple[float, str]:
    """Return u (K) of the block's temperature and its origin: a thermometer, or the air and the band around it."""
    known = {error.name: error for error in hidden_sources(source.bench, source.model)}
    thermometer, band = known.get("thermometer"), known["temperature"]
    if thermometer is not None and source.bench.instruments.thermometer is not None:
        return thermometer.u, thermometer.origin
    of_band = band.origin.partition("; ")[0]  # without the block's temperature coefficients, which follow
    if thermometer is None:
        return band.u, of_band
    return math.hypot(band.u, thermometer.u), f"{of_band}; {thermometer.origin}"


def _span(values: Any) -> tuple[float, float] | None:
    """Return the smallest and the largest value, ignoring NaN; None if there are no values."""
    known = values[~np.isnan(values)]
    return (float(known.min()), float(known.max())) if len(known) else None


def _instruments(source: Source) -> Iterator[Instrument]:
    told = {} if source.origin is None else source.origin.instruments
    serials = {} if source.origin is None else source.origin.serials
    held = {standing.instrument: standing for standing, _ in source.traced.entries}
    for section in source.bench.instruments.all():
        name = section.name
        identity, serial = _one_line(told.get(name, "")), _one_line(serials.get(name, ""))
        if (standing := held.get(name)) is None:
            yield Instrument(name, section.role, identity, serial)
        else:
            own = standing.certificate
            serial = serial or own.serial or ""
            doubts = (standing.expired, standing.foreign, standing.later)
            yield Instrument(name, section.role, identity, serial, own, *doubts)


def _contributions(result: CalibrationResult) -> Iterator[Contribution]:
    own = result.calibration
    scatter = (
        message("readings and stand"),
        "",
        message("scatter of the readings, limits of the stand"),
        False,
    )
    sources = [(scatter, own.covariance_readings)]
    sources += [((one.name, one.size, one.origin, one.prior), one.covariance) for one in own.sources]
    for told, covariance in sources:
        part = u_of(covariance)
        if np.any(part > 0):
            j = int(np.argmax(part / own.u))
            yield Contribution(
                *told, float(part[j]), COEFFICIENTS[j], coefficient_unit(COEFFICIENTS[j], own.unit)
            )


def _result_json(run: Run, result: CalibrationResult, verdict: VerificationResult | None) -> str:
    """Return the result and the verdict as JSON, with the run's name in place of the path of its folder."""
    told = {**result.to_dict(), "verification": None if verdict is None else verdict.to_dict()}
    told["source"] = run.name
    for part in (told, told["verification"] or {}):
        part["bench"] = {**part.get("bench", {}), "file": "bench.yaml"}
    return to_text(_without_folders(told, run))


def _without_folders(told: Any, run: Run) -> Any:
    if isinstance(told, dict):
        return {name: _without_folders(value, run) for name, value in told.items()}
    if isinstance(told, list):
        has_text = any(isinstance(one, str | dict | list) for one in told)
        return [_without_folders(value, run) for value in told] if has_text else told
    return _plain(told, run) if isinstance(told, str) else told


def _plain(text: str, run: Run) -> str:
    return text.replace(str(run.folder.absolute()), run.name).replace(str(run.folder), run.name)


def _one_line(text: str) -> str:
    return " ".join(visible(text).split())


def issued_at(now: datetime) -> str:
    """Return `now` as a certificate states it: civil time to the second, with offset."""
    return now.replace(microsecond=0).isoformat()
