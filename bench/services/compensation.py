"""Coefficients over temperature, a multi-point tumble, and calibrations in forms for navigation computers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import to_text
from bench.base.languages import message
from bench.base.text import listed, repeated
from bench.calibration.budget.whole import acting_sources, sign
from bench.calibration.calibrate import calibrate
from bench.calibration.result import SourceOfError
from bench.calibration.temperature import (
    CompensationTable,
    TemperatureModel,
    levels_of,
    make_table,
    sort_readings,
)
from bench.calibration.temperature_fit import temperature_model
from bench.calibration.tumble import TumbleView, combine, tumble_view
from bench.calibration.verification import Verification, verify
from bench.exchange.checks import c_header, json_test, table_checks, table_csv
from bench.exchange.result import BlockResult
from bench.readings.csv import read_centrifuge
from bench.readings.table import Readings
from bench.results.compensation import CompensateResult, TumbleResult, compensate_result, tumble_result
from bench.services.arguments import python_call
from bench.services.calibration import calibration_of
from bench.services.coefficients import block_result, is_result, results_in
from bench.services.errors import Refused
from bench.services.requests.evaluation import Compensate, Tumble
from bench.services.source import Request, Source, load_sources, one_place, reading
from bench.services.verification import own_judgement

OVER_TEMPERATURE: Final = ("thermometer", "temperature")
"""Errors of the block's temperature; the first that a bench has is that of the temperatures in the readings."""


def _hidden(source: Source, model: TemperatureModel) -> tuple[SourceOfError, ...]:
    """Return the bench errors that no reading shows; all but angles of a mounting are equal at all temperatures.

    Angles of assumed size are in the fit of the model; their covariance is that at its reference. The readings are
    corrected to the reference temperature. Otherwise the fit would take their dependence on the temperature for
    noise, which enlarges the part of the third mounting angle. A mounting may last for several series, as in the
    fit of the model. The error of the temperatures acts through the model's own slopes, not through priors.
    """
    misread, change = _misread(source, model)
    own = sort_readings([source.readings])
    readings = replace(_at(model.reference_c, own.rows, model), series=own.mounting)
    found = calibrate(
        readings,
        source.model,
        source.stand_u,
        source.g_m_s2,
        noise=model.noise,
        assumed_u=source.assumed_u,
        find_shared=False,
    )
    signed = sign(found, readings, source.bench, source.model, source.traced.day, source.known_meters)
    constant = np.ix_(*2 * [model.constant])
    instead = dict.fromkeys(source.assumed_u, model.of_assumed) | {misread: np.outer(change, change)}
    return tuple(
        replace(s, covariance=instead[s.name][constant]) if s.name in instead else s
        for s in signed.sources
        if s.name == misread or s.name not in OVER_TEMPERATURE
    )


def _misread(source: Source, model: TemperatureModel) -> tuple[str, Floats]:
    """Return the error of the temperatures read, and what its u changes in the terms (12 (D + 1),)."""
    sizes = {error.name: error.u for error in acting_sources(model.unit, source.bench, source.model)}
    name = next(name for name in OVER_TEMPERATURE if name in sizes)
    change = np.zeros_like(model.values)
    change[:, :-1] = sizes[name] * np.arange(1, model.values.shape[1]) * model.values[:, 1:]
    return name, change.ravel()


def _at(temperature_c: float, readings: Readings, model: TemperatureModel) -> Readings:
    """Return readings, each of known temperature, with signals corrected by the model to one temperature."""
    block = model.block(temperature_c)
    signal = [
        block.output(model.block(at).specific_force(one))
        for at, one in zip(readings.temperature_c.tolist(), readings.signal, strict=True)
    ]
    return replace(readings, signal=np.array(signal))


def _with(model: TemperatureModel, sources: Iterable[SourceOfError]) -> TemperatureModel:
    """Return the model with these errors in the covariance of the terms at the reference temperature."""
    covariance: Floats = model.covariance.copy()
    for source in sources:
        covariance[np.ix_(model.constant, model.constant)] += source.covariance
    return replace(model, covariance=covariance)


@dataclass(frozen=True)
class Compensation:
    """Coefficients over temperature: `model` of the sources `names`, with compensation `table` and verifications.

    `source` is the first source. Each of the `checks` is a temperature (°C) and the verification at it.
    """

    source: Source
    names: tuple[str, ...]
    model: TemperatureModel
    table: CompensationTable
    checks: tuple[tuple[float, Verification], ...]
    result: CompensateResult

    def accepted(self, *, strict: bool) -> bool:
        """Whether all verifications passed, and model and polynomials fit (p ≥ 1e-4; if `strict`, 0.01)."""
        return _accepted(self.model, self.checks, strict=strict)

    @property
    def of(self) -> str:
        """What was compensated, and from which readings, for the head of a file."""
        unit = self.source.bench.unit_under_test
        of = f"{unit.type} {unit.serial}".strip() + f", from {', '.join(self.names)}"
        of += f", made at {self.source.made_at}" if self.source.made_at else ""
        of += " (simulated instruments)" if self.result.simulated else ""
        return of if self.result.accepted else f"{of}: NOT ACCEPTED, as the fit or a verification failed"

    def files(self) -> Iterator[tuple[str, Path, str]]:
        """Yield description, path and text of each file to write."""
        yield "result", self.source.output("compensate", ".json"), to_text(self.result.to_dict())
        yield (
            message("C header"),
            self.source.output("compensate", ".h"),
            c_header(self.model, self.table, self.of),
        )
        yield (
            message("table", "heading"),
            self.source.output("compensate", ".csv"),
            table_csv(self.model, self.table, self.of),
        )


def _accepted(
    model: TemperatureModel, checks: Iterable[tuple[float, Verification]], *, strict: bool = False
) -> bool:
    tests = [model.fitted, *([model.curve] if model.curve else [])]
    return all(check.passed for _, check in checks) and all(test.accepted(strict=strict) for test in tests)


def compensated(request: Compensate, loaded: Sequence[Source]) -> Compensation:
    """Return the coefficients as polynomials of the temperature. Raises `Refused`, `CalibrationError`."""
    first, names = loaded[0], tuple(source.name for source in loaded)
    strangers = [source.name for source in loaded if source.g_m_s2 != first.g_m_s2]
    if strangers:
        raise Refused(
            f"{', '.join(strangers)}: local gravity differs from that in {first.name}; use runs of one bench"
        )
    tables = [source.readings for source in loaded]
    degree = _degree(request.degree)
    shown = temperature_model(
        tables, first.model, first.stand_u, first.g_m_s2, request.reference, degree, assumed_u=first.assumed_u
    )
    if others := [source.name for source in loaded if source.meters != first.meters]:
        note = (
            f"read by other meters than {first.name}: {listed(others)}; the terms of temperature leave out the "
            "differences of their errors"
        )
        shown = replace(shown, notes=(*shown.notes, note))
    hidden = _hidden(first, shown)
    further = [s for s in hidden if s.name not in (*first.assumed_u, *OVER_TEMPERATURE)]
    combined, same_meters = _with(shown, further), _with(shown, (s for s in further if not s.cancels))
    table = make_table(combined, first.bench.unit_under_test.range, request.step)
    checks = tuple(check for source in loaded for check in _checks(source, same_meters))
    checked = table_checks(combined, table)
    # the thermometer errs alike when the same run is verified
    _, change = _misread(first, shown)
    combined = replace(combined, covariance=combined.covariance + np.outer(change, change))
    result = compensate_result(
        combined,
        of_readings=shown.covariance - shown.of_assumed,
        hidden=hidden,
        shown=table,
        checks=checks,
        check=checked,
        python=json_test(len(checked)),
        sources=names,
        bench=first.taken.part(),
        corrections=[part for source in loaded for part in source.traced.parts()],
        simulated=any(source.simulated for source in loaded),
        accepted=_accepted(combined, checks),
        made_at=first.made_at,
        unit_under_test=first.made_from()["unit_under_test"],
    )
    return Compensation(first, names, combined, table, checks, result)


def _compensate(request: Compensate) -> CompensateResult:
    """Return the coefficients as polynomials of the temperature, as `bench compensate` computes them.

    `reference` is their reference temperature in °C, `degree` is "auto" or a number such as "2", and `step` is the
    step of the table in K. The other parameters are those of `calibrate`.
    """
    return compensated(request, load_sources(reading(request, *request.sources))).result


compensate = python_call(Compensate, _compensate)


def _degree(text: str) -> int | None:
    if text == "auto":
        return None
    if text.isascii() and text.isdecimal() and 1 <= int(text) <= 6:
        return int(text)
    raise Refused(f"--degree {text}: give 'auto' or a whole number from 1 to 6")


def _checks(source: Source, model: TemperatureModel) -> Iterator[tuple[float, Verification]]:
    """Yield each temperature (°C) in the model's range with verification points, and its verification.

    Readings of one temperature plateau are verified together, at its mean temperature.
    """
    rows = source.readings.verification()
    rows = rows.select(np.isfinite(rows.temperature_c) & ~model.outside(rows.temperature_c))
    by = own_judgement(source)
    noise = model.noise.widened().by_channel
    level = levels_of(rows.temperature_c)
    for number in np.unique(level):
        own = rows.select(level == number)
        t = float(np.mean(own.temperature_c))
        own = _at(t, own, model)
        growth = 0.0 if model.growth is None else model.growth
        larger = np.hypot(1.0, growth * (own.signal - model.block(t).U0))
        yield (
            t,
            verify(
                own, model.block(t), model.covariance_at(t), noise * larger, by.limit_g, rule=by.rule,
                population=by.population,
            ),
        )  # fmt: skip


def tumbled(request: Tumble, loaded: Sequence[Source]) -> Iterator[tuple[TumbleView, TumbleResult]]:
    """Yield for each source the IEEE 1293 terms of each axis, and the result with them.

    Raises `CalibrationError` if the readings do not determine the nonlinear terms of the request.
    """
    terms = [term.strip() for term in request.terms.split(",") if term.strip()]
    above = None if request.centrifuge is None else read_centrifuge(Path(request.centrifuge))
    for source in loaded:
        readings = source.readings
        view = tumble_view(
            readings,
            source.model,
            source.stand_u,
            source.g_m_s2,
            terms,
            assumed_u=source.assumed_u,
            above=above,
        )
        view = combine(view, source.bench, source.model, terms, source.traced.day)
        notes = [
            *view.lack_of_fit.diagnose(source.typed),
            *view.notes,
            *readings.notes,
            *readings.skipped,
        ]
        yield view, tumble_result(view, **source.made_from(), notes=notes)


def _tumble(request: Tumble) -> list[TumbleResult]:
    """Return the accelerometers of each source in terms of IEEE 1293, as `bench tumble` computes them.

    `terms` are nonlinear terms such as "K2,K3"; `centrifuge` is a file of points above 1 g that join the fit. The
    other parameters are those of `calibrate`.
    """
    return [result for _, result in tumbled(request, load_sources(reading(request, *request.sources)))]


tumble = python_call(Tumble, _tumble)


# --- for a navigation computer ------------------------------------------------------------------------


@dataclass(frozen=True)
class CalibrationToWrite:
    """A calibration to write in other forms; its files are named after `source` or, if that is None, `stem`."""

    result: BlockResult
    stem: Path
    source: Source | None

    def file(self, suffix: str) -> Path:
        """Return the path of the output file with this suffix."""
        if self.source is None:
            return self.stem.with_name(self.stem.name + suffix)
        return self.source.output("coefficients", suffix, what_if=self.source.what_if)


def results_of(request: Request) -> list[CalibrationToWrite]:
    """Return the calibrations of all sources: readings are calibrated, result files are read. Raises `Refused`."""
    names = [name for name in request.sources if isinstance(name, str) and is_result(Path(name))]
    asked = (request.bench, request.model, request.g_m_s2)
    if names and (any(value is not None for value in asked) or request.skip_bad_rows):
        raise Refused(
            f"{names[0]}: is a result with its own bench file, model and gravity; remove --bench, "
            "--model, --g and --skip-bad-rows, or give its readings"
        )
    found: list[CalibrationToWrite] = []
    for name in request.sources:
        if name in names:
            found += _read(Path(str(name)), request.out)
        else:
            (source,) = load_sources(replace(request, sources=[name]))
            found.append(CalibrationToWrite(calibration_of(source).derived, Path(), source))
    files = [given.file("") for given in found]
    for file in repeated(map(str, files)):
        raise Refused(one_place(file))
    return found


def _read(path: Path, out: Path | None) -> list[CalibrationToWrite]:
    results = results_in(path)
    stem = (out or path.parent / "coefficients") / path.stem
    stems = [stem.with_name(f"{stem.name}-{k}") for k in range(1, len(results) + 1)]
    return [
        CalibrationToWrite(block_result(data, name), own if len(results) > 1 else stem, None)
        for (data, name), own in zip(results, stems, strict=True)
    ]
