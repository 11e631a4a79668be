"""stability: what a static record says of noise and drift, and how long a reading should average."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.analysis.calibration import CalibrationError
from bench.analysis.stability.advice import Averaging, ReadingAdvice, averaging, reading_advice
from bench.analysis.stability.allan import AllanCurve, allan_curve
from bench.analysis.stability.noise_terms import MISFIT_P, TERMS, NoiseTerms, fit_terms
from bench.analysis.stability.static_record import StaticRecord, from_columns, read_static
from bench.base.numbers import MINUS, probability, quantity
from bench.cli import CommandError, printing
from bench.cli.source import bench_path, check_target, to_text, write_beside, write_json
from bench.files.bench.file import BenchFile, load_bench, load_recorded_bench
from bench.procedure.plan import Read
from bench.run.folder import BENCH, find_run

AXES = "xyz"


@dataclass(frozen=True)
class Request:
    """A static record (a file, or a run), the size asked for in the unit of the signals, where to write.

    `integration_s` is how long the meter integrated for each sample; None where all the time, or a run tells.
    """

    record: str
    runs: Path
    bench: str | None
    size: float | None
    integration_s: float | None
    out: Path | None


@dataclass(frozen=True)
class Findings:
    """What was found of each channel, and of the reading that suits all three."""

    curves: list[AllanCurve]
    terms: list[NoiseTerms]
    averages: list[Averaging]
    advice: ReadingAdvice | None
    no_advice: str


def stability(request: Request, target: str | None) -> int:
    """Carry out `bench stability`; 1 when the size asked for is not reached by a channel."""
    check_target(target)
    if request.size is not None and not (np.isfinite(request.size) and request.size > 0):
        raise CommandError(f"--size {request.size}: a size is a positive number in the unit of the signals")
    bench = _bench_of(request)
    record, told_s = _record(request, bench)
    integration_s = request.integration_s or told_s or record.interval_s
    if not 0 < integration_s <= record.interval_s:
        raise CommandError(
            f"--integration {integration_s:g}: a sample cannot integrate longer than the {record.interval_s:.4g} s "
            "from one to the next"
        )
    found = _findings(record, bench, request.size, integration_s)
    result = _json(record, found)
    out = printing.console(json=target)
    _print(record, found, bench, out)
    for what, file in _write(request, record, found, result).items():
        printing.written(what, file, out)
    write_json([result], target)
    return 0 if all(average.reached for average in found.averages) else 1


def _bench_of(request: Request) -> BenchFile:
    """Return the bench file asked for, else that of the run, else the usual one."""
    own = request.runs / request.record / BENCH
    if request.bench is None and not Path(request.record).is_file() and own.is_file():
        return load_recorded_bench(own)
    return load_bench(bench_path(request.bench))


def _record(request: Request, bench: BenchFile) -> tuple[StaticRecord, float | None]:
    """Return the record, and how long each sample integrated where a run tells it."""
    path = Path(request.record)
    if path.is_file():
        return read_static(path), None
    if path.suffix.lower() in {".csv", ".txt"}:
        raise CommandError(f"{request.record}: no such file; check the name")
    run = find_run(request.record, request.runs)
    readings = run.readings()
    settings = set(zip(readings.installation, readings.series, readings.target_rad, strict=True))
    if len(settings) > 1:
        raise CommandError(
            f"{request.record}: the block was turned in this run; a static record is one setting "
            "(procedure 'stability')"
        )
    told = {step.samples * step.nplc for step in run.plan.steps if isinstance(step, Read)}
    integration_s = min(told) / bench.line_frequency if told else None
    return from_columns(request.record, readings.unit, readings.time_s, readings.signal), integration_s


def _findings(record: StaticRecord, bench: BenchFile, size: float | None, integration_s: float) -> Findings:
    curves = [allan_curve(record.signal[:, i], record.interval_s) for i in range(3)]
    terms = [fit_terms(curve) for curve in curves]
    averages = [averaging(c, t, size) for c, t in zip(curves, terms, strict=True)]
    longest = max(average.tau_s for average in averages)
    integrated_s = longest * integration_s / record.interval_s
    try:
        advice = reading_advice(integrated_s, bench.line_frequency, bench.nplc_supported, bench.most_samples)
    except CalibrationError as error:
        return Findings(curves, terms, averages, None, str(error))
    return Findings(curves, terms, averages, advice, "")


def _json(record: StaticRecord, found: Findings) -> dict[str, Any]:
    channels = {}
    for i, axis in enumerate(AXES):
        curve, terms, average = found.curves[i], found.terms[i], found.averages[i]
        low, high = curve.limits(terms.freedom)
        channels[axis] = {
            "mean": float(record.mean[i]),
            "drift_per_hour": float(record.drift_per_s[i] * 3600.0),
            "tau_s": curve.tau_s.tolist(),
            "allan_deviation": curve.deviation.tolist(),
            "low_95": low.tolist(),
            "high_95": high.tolist(),
            "edf": terms.freedom.tolist(),
            "terms": terms.to_json(),
            "terms_p": terms.p,
            "averaging": {
                "tau_s": average.tau_s,
                "deviation": average.deviation,
                "why": average.why,
                "reached": average.reached,
            },
        }
    advice = found.advice
    return {
        "source": record.source,
        "unit": record.unit,
        "samples": len(record.signal),
        "interval_s": record.interval_s,
        "channels": channels,
        "reading": advice and {"samples": advice.samples, "nplc": advice.nplc, "averaging_s": advice.tau_s},
        "no_reading": found.no_advice or None,
    }


def _print(record: StaticRecord, found: Findings, bench: BenchFile, out: Console) -> None:
    out.print(
        f"Static record {record.source}: {len(record.signal)} samples of {record.interval_s:.4g} s, "
        f"{record.duration_s:.4g} s, in {record.unit}"
    )
    out.print(_table(record, found))
    for i, axis in enumerate(AXES):
        out.print(f"channel {axis}: {found.averages[i].tau_s:.3g} s: {found.averages[i].why}")
        if found.terms[i].p < MISFIT_P:
            out.print(
                f"note: channel {axis}: the five noise terms alone do not make this curve "
                f"({probability(found.terms[i].p)}): vibration or another line is in it; their uncertainties "
                "are widened"
            )
    if found.advice is None:
        out.print(f"no reading follows: {found.no_advice}")
        return
    out.print(
        f"a reading that integrates for {found.advice.tau_s:.3g} s at {bench.line_frequency:g} Hz "
        f"(settling and the meter's own pauses come on top):"
    )
    out.print(found.advice.line())


def _table(record: StaticRecord, found: Findings) -> Table:
    """A column for each channel: mean, drift, the noise terms with u or what they are below, the averaging."""
    unit = record.unit
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for axis in AXES:
        table.add_column(axis, justify="right")
    table.add_row("mean", *(f"{mean:.7g} {unit}" for mean in record.mean))
    table.add_row("drift", *(_signed(3600.0 * slope, unit) + "/h" for slope in record.drift_per_s.tolist()))
    for k, term in enumerate(TERMS):
        table.add_row(f"{term.name} {term.symbol}", *(_shown(terms, k, unit) for terms in found.terms))
    table.add_row("averaging time", *(f"{average.tau_s:.3g} s" for average in found.averages))
    table.add_row("noise left", *(quantity(average.deviation, unit) for average in found.averages))
    return table


def _signed(value: float, unit: str) -> str:
    return quantity(value, unit) if value >= 0 else MINUS + quantity(-value, unit)


def _shown(terms: NoiseTerms, k: int, unit: str) -> str:
    if terms.shown[k]:
        share = terms.u[k] / terms.values[k]
        return f"{quantity(float(terms.values[k]), unit)}{TERMS[k].unit} ± {100 * share:.1f} %"
    return f"< {quantity(float(terms.upper[k]), unit)}{TERMS[k].unit}"


def _write(
    request: Request, record: StaticRecord, found: Findings, result: dict[str, Any]
) -> dict[str, Path]:
    from bench.report.stability import allan_figure

    path = Path(request.record)
    if path.is_file():
        stem = (request.out or path.parent / "stability") / path.stem
    else:
        run = find_run(request.record, request.runs)
        stem = request.out / f"{run.name}-stability" if request.out else run.folder / "stability"
    longest = max(average.tau_s for average in found.averages)
    texts = {
        ("result", ".json"): to_text(result),
        ("figure", ".svg"): allan_figure(found.curves, found.terms, record.unit, longest),
    }
    files = {what: stem.with_name(stem.name + suffix) for what, suffix in texts}
    asked = request.out is not None
    return {
        what: files[what] for (what, _), text in texts.items() if write_beside(files[what], text, asked=asked)
    }
