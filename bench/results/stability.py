"""The result of `bench stability`: noise and drift of a record at rest; as JSON, as text and as a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.languages import HEADING, message, translated
from bench.base.numbers import MINUS, probability, quantity, scale_for
from bench.base.result_model import Real, ResultModel, Vector
from bench.base.tables import print_notes, table
from bench.history.stability import Averaging, Stability
from bench.results.parts import BenchPart
from bench.results.plots import BLUE, GREEN, GREY, VERMILION, svg_figure, svg_file
from bench.stats.allan import MISFIT_P, TERMS, NoiseTerms

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class TermPart(ResultModel):
    """A noise term of the Allan deviation, in the unit of the signal and seconds."""

    value: Real = Field(description="coefficient of the term; null if not significant")
    u: Real = Field(description="standard uncertainty; null if the term is not significant")
    upper: float = Field(description="upper limit of the coefficient")
    called: str


class SpectrumPart(ResultModel):
    """The one-sided power spectral density of a channel (Welch, Hann windows)."""

    frequency_hz: Vector
    density: Vector = Field(description="unit of the signal squared per Hz; white noise N gives 2 N²")
    segments: int = Field(description="number of segments averaged, each overlapping the next by half")


class ChannelPart(ResultModel):
    """The stability of a channel."""

    mean: float
    drift_per_hour: float = Field(description="slope of a straight line through the signal, per hour")
    tau_s: Vector = Field(description="averaging times, s")
    allan_deviation: Vector = Field(description="overlapping Allan deviation at each averaging time")
    low_95: Vector
    high_95: Vector
    edf: Vector = Field(description="degrees of freedom of each deviation")
    terms: dict[str, TermPart] = Field(description="noise terms by name: Q, N, B, K, R")
    terms_p: Real = Field(description="p-value of the fit of the five terms to the deviations")
    psd: SpectrumPart
    averaging: Averaging


class ReadingPart(ResultModel):
    """The recommended settings of a reading for a procedure file."""

    samples: int
    nplc: float
    averaging_s: float


class StabilityResult(ResultModel):
    """The Allan deviation of a record at rest, and the recommended settings of a reading."""

    source: str
    unit: str = Field(description="unit of the signals")
    samples: int
    interval_s: float
    channels: dict[str, ChannelPart] = Field(description="stability of each channel, by its name")
    reading: ReadingPart | None
    no_reading: str | None = Field(description="why no averaging time is proposed")
    notes: list[str] = Field(description="remarks on the times of the samples")
    bench: BenchPart


def stability_result(found: Stability, bench: BenchPart) -> StabilityResult:
    """Return the result of a stability analysis; `bench` is the bench file that was used."""
    record, advice = found.record, found.advice
    return StabilityResult.from_object(
        record,
        samples=len(record.signal),
        channels={channel: _channel(found, i) for i, channel in enumerate(record.channels)},
        reading=advice and ReadingPart.from_object(advice, averaging_s=advice.tau_s),
        no_reading=found.no_advice or None,
        bench=bench,
    )


def _channel(found: Stability, i: int) -> ChannelPart:
    curve, terms, record = found.curves[i], found.terms[i], found.record
    low, high = curve.limits(terms.freedom)
    rows = zip(TERMS, terms.values, terms.u, terms.upper, terms.shown, strict=True)
    return ChannelPart(
        mean=record.mean[i],
        drift_per_hour=record.drift_per_s[i] * 3600.0,
        tau_s=curve.tau_s,
        allan_deviation=curve.deviation,
        low_95=low,
        high_95=high,
        edf=terms.freedom,
        terms={
            term.symbol: TermPart(
                value=value if shown else None, u=u if shown else None, upper=upper, called=term.name
            )
            for term, value, u, upper, shown in rows
        },
        terms_p=terms.p,
        psd=SpectrumPart.from_object(found.spectrum, density=found.spectrum.density[:, i]),
        averaging=found.averages[i],
    )


# --- as text ------------------------------------------------------------------------------------------


def print_stability(found: Stability, out: Console) -> None:
    """Print noise terms and averaging time of each channel, and the recommended settings of a reading."""
    record = found.record
    out.print(
        f"Static record {record.source}: {len(record.signal)} samples of {record.interval_s:.4g} s, "
        f"{record.duration_s:.4g} s, in {record.unit}"
    )
    out.print(_table(found))
    lines = zip(averaging_lines(found), record.channels, found.terms, strict=True)
    for line, channel, terms in lines:
        out.print(line)
        if terms.p < MISFIT_P:
            misfit = message(
                f"channel {channel}: the five noise terms do not explain this curve "
                f"({probability(terms.p)}): it may contain vibration or another line; their uncertainties "
                "are widened"
            )
            print_notes(out, [misfit])
    if found.advice is None:
        out.print(f"no settings of a reading to recommend: {found.no_advice}")
        return
    out.print(
        f"a reading that integrates for {found.advice.tau_s:.3g} s at {found.line_frequency_hz:g} Hz "
        f"(plus settling and the meter's pauses):"
    )
    out.print(found.advice.line())


def averaging_lines(found: Stability) -> list[str]:
    """Return a line for each channel on its averaging time."""
    pairs = zip(found.record.channels, found.averages, strict=True)
    return [f"channel {channel}: {average.tau_s:.3g} s: {average.why}" for channel, average in pairs]


def _table(found: Stability) -> Table:
    record, unit = found.record, found.record.unit
    shown = table("", *(f">{channel}" for channel in record.channels))
    shown.add_row(translated("mean", HEADING), *(f"{mean:.7g} {unit}" for mean in record.mean))
    slopes = (3600.0 * record.drift_per_s).tolist()
    shown.add_row(
        translated("drift", HEADING), *(f"{MINUS if s < 0 else ''}{quantity(abs(s), unit)}/h" for s in slopes)
    )
    for k, term in enumerate(TERMS):
        shown.add_row(
            f"{translated(term.name, HEADING)} {term.symbol}",
            *(_term(terms, k, unit) for terms in found.terms),
        )
    shown.add_row(message("averaging time"), *(f"{average.tau_s:.3g} s" for average in found.averages))
    shown.add_row(message("noise left"), *(quantity(average.deviation, unit) for average in found.averages))
    return shown


def _term(terms: NoiseTerms, k: int, unit: str) -> str:
    if terms.shown[k]:
        share = terms.u[k] / terms.values[k]
        return f"{quantity(float(terms.values[k]), unit)}{TERMS[k].unit} ± {100 * share:.1f} %"
    return f"< {quantity(float(terms.upper[k]), unit)}{TERMS[k].unit}"


# --- as a figure --------------------------------------------------------------------------------------


def allan_figure(found: Stability, *, inline: bool = False) -> str:
    """Return a plot of Allan deviation, noise terms and spectrum: an SVG file, or an element if `inline`."""
    curves, terms, tau_s = found.curves, found.terms, found.longest_s
    scale = scale_for(min(float(curve.deviation.min()) for curve in curves), found.record.unit)

    def draw(figure: Figure) -> None:
        axes, below = figure.subplots(2)
        look = zip(
            found.record.channels, (BLUE, VERMILION, GREEN), ("o", "s", "^"), curves, terms, strict=False
        )
        for i, (channel, colour, marker, curve, term) in enumerate(look):
            low, high = curve.limits(term.freedom)
            reach = np.stack([curve.deviation - low, high - curve.deviation]) / scale.size
            axes.errorbar(
                curve.tau_s, curve.deviation / scale.size, reach,
                fmt=marker, color=colour, capsize=2, linewidth=0.9, label=message(f"channel {channel}"),
            )  # fmt: skip
            fine = np.geomspace(curve.tau_s[0], curve.tau_s[-1], 200)
            axes.plot(fine, term.deviation(fine) / scale.size, color=colour, linewidth=0.8, alpha=0.7)
            root = np.sqrt(found.spectrum.density[:, i]) / scale.size
            below.plot(found.spectrum.frequency_hz, root, color=colour, linewidth=0.8)
        axes.axvline(tau_s, color=GREY, linestyle=(0, (4, 3)), linewidth=0.9)
        for one in (axes, below):
            one.set_xscale("log")
            one.set_yscale("log")
        axes.set_xlabel(message("averaging time / s"))
        axes.set_ylabel(message(f"Allan deviation / {scale.unit}"))
        axes.set_title(message(f"overlapping, limits 95 %; lines: the noise terms; dashed: {tau_s:.3g} s"))
        below.set_xlabel(message("frequency / Hz"))
        below.set_ylabel(message(f"root of the spectral density / ({scale.unit}/√Hz)"))
        figure.legend(loc="outside upper center", ncols=3)

    if not inline:
        return svg_file("allan", (6.4, 7.2), draw)
    return svg_figure(
        "allan", (6.4, 7.2), draw, message("Allan deviation over averaging time, spectrum over frequency")
    )
