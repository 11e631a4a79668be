"""stability: what a static record says of noise and drift, and how long a reading should average."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.computing import tracked
from bench.base.numbers import MINUS, probability, quantity
from bench.cli import printing, progress
from bench.cli.options import RUNS, BenchOption, JsonOption, OutOption, RunsOption, app
from bench.services.errors import Refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.config.bench_file.file import BenchFile
    from bench.history.stability import Averaging, ReadingAdvice, StaticRecord
    from bench.services.bench_selection import BenchTaken
    from bench.stats.allan import AllanCurve, NoiseTerms

AXES = "xyz"


@app.command(epilog="Example: bench stability static.csv --size 20e-6 --bench my-bench.yaml")
def stability(
    record: Annotated[
        str, typer.Argument(metavar="FILE", help="Static record (CSV: time_s,ux_v,uy_v,uz_v), or a run.")
    ],
    size: Annotated[
        float | None,
        typer.Option(help="Noise that a reading may have, unit of the signals (default: where it flattens)."),
    ] = None,
    integration: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="How long the meter integrated for each sample (default: all the time)."
        ),
    ] = None,
    bench: BenchOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Allan deviation and noise terms of a block at rest, and the averaging that a reading deserves."""
    printing.check_target(json)
    if size is not None and not (math.isfinite(size) and size > 0):
        raise Refused(f"--size {size}: a size is a positive number in the unit of the signals")
    on = printing.console(json=json)
    taken, notes = _bench_of(record, runs, bench)
    printing.bench_file(taken, json)
    printing.notes_on(on, notes)
    file = taken.file
    static, recorded_s = _record(record, runs, file)
    integration_s = integration or recorded_s or static.interval_s
    if not 0 < integration_s <= static.interval_s:
        raise Refused(
            f"--integration {integration_s:g}: a sample cannot integrate longer than the {static.interval_s:.4g} s "
            "from one to the next"
        )
    with progress.shown():
        found = _findings(static, file, size, integration_s)
    result = {**_json(static, found), "bench": taken.to_dict()}
    _print(static, found, file, on)
    files = _write(_stem(record, runs, out), static, found, result, asked=out is not None)
    for what, written in files.items():
        printing.written(what, written, on)
    printing.write_json([result], json)
    return 0 if all(average.reached for average in found.averages) else 1


@dataclass(frozen=True)
class _Findings:
    """What was found of each channel, and of the reading that suits all three."""

    curves: list[AllanCurve]
    terms: list[NoiseTerms]
    averages: list[Averaging]
    advice: ReadingAdvice | None
    no_advice: str


def _bench_of(record: str, runs: Path, bench: str | None) -> tuple[BenchTaken, tuple[str, ...]]:
    """Return the bench file asked for, else that of the run or told beside the record, else the usual one."""
    from bench.run.folder import BENCH, Run
    from bench.services.bench_selection import Told, bench_of, origin_beside

    if Path(record).is_file():
        return bench_of(record, None, origin_beside(Path(record)), bench)
    run = next((Run(folder) for folder in (runs / record, Path(record)) if (folder / BENCH).is_file()), None)
    return bench_of(record, run, Told(), bench)


def _record(name: str, runs: Path, bench: BenchFile) -> tuple[StaticRecord, float | None]:
    """Return the record, and how long each sample integrated where a run tells it."""
    from bench.config.procedure.plan import Read
    from bench.history.stability import from_columns, read_static
    from bench.run.folder import find_run

    path = Path(name)
    if path.is_file():
        return read_static(path), None
    if path.suffix.lower() in {".csv", ".txt"}:
        raise Refused(f"{name}: no such file; check the name")
    run = find_run(name, runs)
    readings = run.readings()
    settings = set(zip(readings.installation, readings.series, readings.target_rad, strict=True))
    if len(settings) > 1:
        raise Refused(
            f"{name}: the block was turned in this run; a static record is one setting "
            "(procedure 'stability')"
        )
    integrated = {step.samples * step.nplc for step in run.plan.steps if isinstance(step, Read)}
    integration_s = min(integrated) / bench.line_frequency if integrated else None
    return from_columns(name, readings.unit, readings.time_s, readings.signal), integration_s


def _findings(record: StaticRecord, bench: BenchFile, size: float | None, integration_s: float) -> _Findings:
    from bench.calibration import CalibrationError
    from bench.history.stability import averaging, reading_advice
    from bench.stats.allan import allan_curve, fit_terms

    channels = tracked(range(3), "Allan deviation of the channels")
    curves = [allan_curve(record.signal[:, i], record.interval_s) for i in channels]
    terms = [fit_terms(curve) for curve in tracked(curves, "noise terms of the channels")]
    averages = [averaging(c, t, size) for c, t in zip(curves, terms, strict=True)]
    longest = max(average.tau_s for average in averages)
    integrated_s = longest * integration_s / record.interval_s
    try:
        advice = reading_advice(integrated_s, bench.line_frequency, bench.nplc_supported, bench.most_samples)
    except CalibrationError as error:
        return _Findings(curves, terms, averages, None, str(error))
    return _Findings(curves, terms, averages, advice, "")


def _json(record: StaticRecord, found: _Findings) -> dict[str, Any]:
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


def _print(record: StaticRecord, found: _Findings, bench: BenchFile, out: Console) -> None:
    from bench.stats.allan import MISFIT_P

    out.print(
        f"Static record {record.source}: {len(record.signal)} samples of {record.interval_s:.4g} s, "
        f"{record.duration_s:.4g} s, in {record.unit}"
    )
    out.print(_table(record, found))
    for i, axis in enumerate(AXES):
        out.print(f"channel {axis}: {found.averages[i].tau_s:.3g} s: {found.averages[i].why}")
        if found.terms[i].p < MISFIT_P:
            misfit = (
                f"channel {axis}: the five noise terms alone do not make this curve "
                f"({probability(found.terms[i].p)}): vibration or another line is in it; their uncertainties "
                "are widened"
            )
            printing.notes_on(out, [misfit])
    if found.advice is None:
        out.print(f"no reading follows: {found.no_advice}")
        return
    out.print(
        f"a reading that integrates for {found.advice.tau_s:.3g} s at {bench.line_frequency:g} Hz "
        f"(settling and the meter's own pauses come on top):"
    )
    out.print(found.advice.line())


def _table(record: StaticRecord, found: _Findings) -> Table:
    """A column for each channel: mean, drift, the noise terms with u or what they are below, the averaging."""
    from bench.stats.allan import TERMS

    unit = record.unit
    table = printing.table("", *(f">{axis}" for axis in AXES))
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
    from bench.stats.allan import TERMS

    if terms.shown[k]:
        share = terms.u[k] / terms.values[k]
        return f"{quantity(float(terms.values[k]), unit)}{TERMS[k].unit} ± {100 * share:.1f} %"
    return f"< {quantity(float(terms.upper[k]), unit)}{TERMS[k].unit}"


def _stem(record: str, runs: Path, out: Path | None) -> Path:
    """Return the name without suffix of what is written."""
    from bench.run.folder import find_run

    path = Path(record)
    if path.is_file():
        return (out or path.parent / "stability") / path.stem
    run = find_run(record, runs)
    return out / f"{run.name}-stability" if out else run.folder / "stability"


def _write(
    stem: Path, record: StaticRecord, found: _Findings, result: dict[str, Any], *, asked: bool
) -> dict[str, Path]:
    from bench.base.files import to_text
    from bench.results.figures import allan_figure

    longest = max(average.tau_s for average in found.averages)
    texts = {
        ("result", ".json"): to_text(result),
        ("figure", ".svg"): allan_figure(found.curves, found.terms, record.unit, longest),
    }
    files = {what: stem.with_name(stem.name + suffix) for what, suffix in texts}
    return {
        what: files[what]
        for (what, _), text in texts.items()
        if printing.write_beside(files[what], text, asked=asked)
    }
