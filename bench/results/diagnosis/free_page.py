"""The page of a diagnosis of free positions, with its figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from bench.base.arrays import CHANNELS, Floats
from bench.base.numbers import aligned, concise, quantity, rounded, scale_for, typeset
from bench.diagnosis.free_result import FreeDiagnosis
from bench.model.effects import CATALOGUE
from bench.model.geometry import COEFFICIENTS
from bench.results.diagnosis import free_words, plots, words
from bench.results.plots import BLUE, GREY, PASS_COLOURS, PASS_FILLS, VERMILION, legend_of, svg_figure
from bench.results.tables import Row, symbol
from bench.results.template import page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


INK: Final = "#222222"
MARKS: Final = "osD^vP*X"
BARS: Final = 0.8
"""Of the room of a record, what its bars fill."""


def overlay(found: FreeDiagnosis, sensor: int) -> str:
    """Signals of a sensor in the order of measurement, a row for each channel: measured over simulated.

    Nobody knows how it lay: it is simulated in the direction that its signals give, where a modulus other than 1 g
    shows. On the right both less what the model as it was given simulates, magnified.
    """
    rows = found.rows
    mine = rows.sensor == sensor
    signal = rows.tables[sensor].signal
    per_g = rows.direction[mine] @ rows.block[sensor].K.T
    given, last = (per_g * fit.left[mine][:, None] for fit in (found.before, found.after))
    size = scale_for(float(np.max(np.abs(signal))), rows.tables[sensor].unit)
    scale = scale_for(float(np.max(np.abs(given))), rows.tables[sensor].unit)
    number = np.arange(1, len(signal) + 1)
    whose = "with what was found" if found.found else "as it was given"

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, 2, sharex=True, squeeze=False)
        for i, channel in enumerate(CHANNELS):
            left: Axes = grid[i, 0]
            left.plot(
                number, (signal - last)[:, i] / size.size, "_", color=INK, markersize=9, markeredgewidth=1.4,
                label=f"simulated, {whose}",
            )  # fmt: skip
            left.plot(
                number, signal[:, i] / size.size, "o", color=BLUE, markersize=3.5, alpha=0.8, label="measured"
            )
            left.set_ylabel(f"channel {channel} / {size.unit}")
            right: Axes = grid[i, 1]
            right.axhline(
                0.0, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), label="simulated as it was given"
            )
            right.plot(number, given[:, i] / scale.size, "o", color=BLUE, markersize=3.5, alpha=0.8)
            if found.found:
                right.plot(
                    number,
                    (given - last)[:, i] / scale.size,
                    "_",
                    color=INK,
                    markersize=9,
                    markeredgewidth=1.4,
                )
            right.set_ylabel(scale.unit)
        _mark_records(grid.flat, rows.record[mine])
        grid[0, 0].set_title(f"sensor {sensor + 1}" if rows.sensors > 1 else "signals")
        grid[0, 1].set_title("less the sensor simulated as it was given")
        for axes in grid[2]:
            axes.set_xlabel("position, in the order of measurement")
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=3)

    alt = (
        f"Measured and simulated signals of channels x, y, z of sensor {sensor + 1} at {len(signal)} positions, "
        "and both less the sensor simulated as it was given"
    )
    return svg_figure(f"free-overlay-{sensor}", (7.6, 5.6), draw, alt)


def _mark_records(all_axes: Any, record: Floats) -> None:
    """Draw a line where another record begins."""
    edges = np.flatnonzero(np.diff(record)) + 1.5
    for axes in all_axes:
        for edge in edges:
            axes.axvline(edge, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))


def modulus_in_time(found: FreeDiagnosis) -> str:
    """|a| - 1 of each position against the time in its record, as it was given, and with what was found."""
    rows = found.rows
    fits = [("as it was given", found.before), ("with what was found", found.after)][: 1 + bool(found.found)]
    scale = scale_for(float(np.max(np.abs(found.before.left))), "g")
    time_s = np.concatenate([table.conditions().elapsed_s for table in rows.tables])
    for record in np.unique(rows.record):
        time_s[rows.record == record] -= time_s[rows.record == record].min()

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(1, len(fits), sharex=True, squeeze=False)
        for axes, (title, fit) in zip(grid[0], fits, strict=True):
            axes.axhline(0.0, color=GREY, linewidth=0.7)
            for number in (2.0, -2.0):
                axes.axhline(
                    number * found.noise_g / scale.size, color=GREY, linestyle=(0, (6, 3)), linewidth=0.9,
                    label="two standard deviations of the noise",
                )  # fmt: skip
            for record in np.unique(rows.record):
                for sensor in range(rows.sensors):
                    mine = (rows.record == record) & (rows.sensor == sensor)
                    axes.plot(
                        time_s[mine] / 60.0, fit.left[mine] / scale.size, MARKS[sensor % len(MARKS)],
                        color=PASS_COLOURS[record % len(PASS_COLOURS)],
                        fillstyle=PASS_FILLS[record // len(PASS_COLOURS) % len(PASS_FILLS)], markersize=3.5,
                        label=_which(found, sensor, int(record)),
                    )  # fmt: skip
            axes.set_title(title)
            axes.set_xlabel("time in the record / min")
        grid[0, 0].set_ylabel(f"|a| − 1 g / {scale.unit}")
        figure.legend(*_few(grid), loc="outside upper center", ncols=5)

    alt = "The modulus of the specific force less 1 g against the time in its record, before and after"
    return svg_figure("free-time", (7.6, 3.4), draw, alt)


def _which(found: FreeDiagnosis, sensor: int, record: int) -> str:
    """Return what a mark is of, as few words as there are sensors and records."""
    return f"record {record + 1}" if sensor == 0 or found.rows.sensors == 1 else f"_sensor {sensor + 1}"


def _few(grid: Any) -> tuple[list[Any], list[str]]:
    handles, labels = legend_of(grid.flat)
    shown = [(h, label) for h, label in zip(handles, labels, strict=True) if not label.startswith("_")]
    return [h for h, _ in shown], [label for _, label in shown]


def modulus_by_record(found: FreeDiagnosis) -> str:
    """Root mean square of |a| - 1 of each sensor in each record, as it was given, and with what was found."""
    rows = found.rows
    records = np.unique(rows.record)
    scale = scale_for(float(np.max(np.abs(found.before.left))), "g")
    width = BARS / rows.sensors

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for sensor in range(rows.sensors):
            at = np.arange(len(records)) + (sensor - (rows.sensors - 1) / 2) * width
            for fit, colour, part, what in (
                (found.before, VERMILION, 1.0, "as it was given"),
                (found.after, BLUE, 0.55, "with what was found"),
            ):
                if fit is found.before or found.found:
                    sizes = [_rms(fit.left[(rows.record == r) & (rows.sensor == sensor)]) for r in records]
                    axes.bar(
                        at, np.array(sizes) / scale.size, width=0.9 * part * width, color=colour,
                        label=what,
                    )  # fmt: skip
        axes.axhline(
            found.noise_g / scale.size, color=GREY, linestyle=(0, (6, 3)), linewidth=1.1, label="noise alone"
        )
        axes.set_xticks(np.arange(len(records)), [f"record {r + 1}" for r in records])
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(f"|a| − 1 g, rms / {scale.unit}")
        figure.legend(*legend_of(iter([axes])), loc="outside upper center", ncols=3)

    alt = f"Root mean square of the modulus less 1 g in {len(records)} records of {rows.sensors} sensors"
    return svg_figure("free-records", (6.4, 3.0), draw, alt)


def _rms(part: Floats) -> float:
    return float(np.sqrt(np.mean(part**2))) if len(part) else 0.0


MOST_DRAWN: Final = 8
"""Sensors of which signals are drawn."""
STATES: Final = {"agrees": "passed", "named": "none", "confounded": "none"}
"""Colour of the verdict; of the others it is that of a failure."""


def render_free(
    found: FreeDiagnosis,
    title: str,
    provenance: Mapping[str, str],
    *,
    simulated: bool,
    models: Sequence[str],
    copies: Sequence[str],
) -> str:
    """Return the page; the same content gives the same text. `models` and `copies` are files that were written."""
    drawn = [_drawn(overlay(found, s)) for s in range(min(found.rows.sensors, MOST_DRAWN))]
    return page(
        "free_diagnosis.html.j2",
        title=title,
        found=found,
        simulated=simulated,
        source=free_words.named(found),
        provenance=provenance,
        state=STATES.get(found.verdict, "failed"),
        lead=free_words.lead(found),
        what=free_words.what(found),
        gap=free_words.gap(found),
        to_do=list(free_words.what_to_do(found, models, copies)),
        words=words,
        quantity=quantity,
        effects=[(free_words.title(one), one, free_words.parameters(one)) for one in found.found],
        overlays=drawn,
        in_time=_drawn(modulus_in_time(found)),
        by_record=_drawn(modulus_by_record(found)) if found.records > 1 else None,
        gap_bars=_drawn(plots.gap_bars(found.gap)) if found.found and found.gap.folds else None,
        held_out=[
            Row(
                fold.label,
                (
                    ", ".join(fold.gains) or "nothing",
                    f"{fold.before.reduced:.2f}",
                    f"{fold.after.reduced:.2f}",
                ),
            )
            for fold in found.gap.folds
        ],
        places=[
            Row(p["pattern"], (quantity(p["size"], "g"), typeset(words.p_in_column(p["p"]))))
            for p in found.where
        ],
        coefficients=list(_coefficients(found)),
        zeros=list(_zeros(found)),
        models=models,
        hidden=[CATALOGUE[name] for name in found.to_dict()["hidden"]],
    )


def _drawn(svg: str) -> Markup:
    return Markup(svg)  # noqa: S704 - our own drawing


def _coefficients(found: FreeDiagnosis) -> Iterator[tuple[int, list[Row]]]:
    """Yield the coefficients of each sensor as they are by the model before and after; six of K by convention."""
    unit = found.rows.tables[0].unit
    for sensor in range(found.rows.sensors):
        pairs = [
            (fit.block[sensor].vector.tolist(), fit.u[sensor].tolist()) for fit in (found.before, found.after)
        ]
        (old, u_old), (new, u_new) = pairs
        shown = [i for i in range(len(old)) if u_old[i] > 0.0]
        before = aligned([concise(old[i], u_old[i]) for i in shown])
        after = aligned([concise(new[i], u_new[i]) for i in shown])
        scale = scale_for(max(abs(new[i] - old[i]) for i in shown), unit)
        rows = []
        for i, was, now in zip(shown, before, after, strict=True):
            change = rounded((new[i] - old[i]) / scale.size, max(u_old[i], u_new[i]) / scale.size, sign=True)
            printed = scale.unit if COEFFICIENTS[i].startswith("U0") else scale.per_g
            rows.append(Row(symbol(COEFFICIENTS[i]), (was, now, change, printed)))
        yield sensor, rows


def _zeros(found: FreeDiagnosis) -> Iterator[Row]:
    """Yield the zeros of each sensor in each record, fitted by itself, in mg with u."""
    between = found.between
    if between is None:
        return
    for sensor in range(found.rows.sensors):
        for record in range(between.zero.shape[1]):
            values = 1e3 * between.zero[sensor, record]
            u = 1e3 * between.u[sensor, record]
            cells = tuple(
                concise(float(values[i]), float(u[i])) if np.isfinite(values[i]) else "not determined"
                for i in range(len(CHANNELS))
            )
            yield Row(f"sensor {sensor + 1}, record {record + 1}", cells)
