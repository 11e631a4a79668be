"""The tables of the report: numbers rounded and aligned as text for the page."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jinja2 import Environment
from markupsafe import Markup

from bench.base.arrays import ARCSEC, CHANNELS, Floats, u_of
from bench.base.languages import language, message, translated
from bench.base.numbers import aligned, concise, fixed, places, quantity, rounded, scale_for, uncertainty
from bench.base.template_texts import environment_for
from bench.base.text import shown_path, visible
from bench.calibration import Calibration, Estimate
from bench.calibration.budget.propagation import correlation_of
from bench.calibration.design import SYMBOLS
from bench.calibration.result import NOT_DETERMINED
from bench.calibration.verification import Verification
from bench.model.effects import CATALOGUE
from bench.model.geometry import COEFFICIENTS
from bench.results.plots import residual_scale
from bench.results.verification import numbers_in_words, optional_probability

if TYPE_CHECKING:
    from bench.calibration.intrinsic import Intrinsic

MEANINGS: Final = {
    "axis_tilt": message("axis tilt"),
    "zero_offset": message("zero offset"),
    "mounting_error": message("mounting error"),
    "mounting_offset": message("mounting turn about the shaft"),
    "mounting_roll": message("mounting error, third angle"),
}

HARDLY: Final = 0.01
"""Contributions below this fraction of the table's unit are printed as a dash."""
SHOWS: Final = 2.0
"""A stand angle shows in the data if it differs from zero by more than this many u."""


class Row:
    """A row of a table: its heading (which may contain markup) and its cells; `bad` highlights the row."""

    def __init__(self, head: str, *cells: str, bad: bool = False) -> None:
        self.head, self.cells, self.bad = head, cells, bad


def symbol(name: str) -> Markup:
    """Return the name of a coefficient or intrinsic number as HTML: "Kxy" -> <i>K</i><sub>xy</sub>."""
    if name.startswith("U0"):
        return Markup("<i>U</i><sub>0{}</sub>").format(name[2:])
    if name.startswith("theta_"):
        return Markup("<i>θ</i><sub>{}</sub>").format(name[6:])
    return Markup("<i>{}</i><sub>{}</sub>").format(name[0], name[1:])


# --- coefficients -----------------------------------------------------------------------------------


def matrix(calibration: Calibration) -> list[list[str]]:
    """Return the rows of K, with U0 as the fourth column, in concise notation: "1.2345(67)"."""
    pairs = zip(calibration.block.vector, calibration.u, strict=True)
    both = ["0" if v == u == 0.0 else concise(float(v), float(u)) for v, u in pairs]
    return [[*both[3 * i : 3 * i + 3], both[9 + i]] for i in range(3)]


def coefficient_groups(calibration: Calibration) -> list[tuple[str, list[Row]]]:
    """Return the title and the rows of each group: scale factors, cross-axis terms and biases.

    The cells of a row are: value, its unit; u from the readings alone, u, U, the unit of these three; then
    relative u (ppm) of a scale factor, angle of a cross-axis term or acceleration of a bias, and its unit.
    """
    vector, u = calibration.block.vector, calibration.u
    scale = scale_for(float(np.max(u)), calibration.unit)
    base = scale_for(1.0, calibration.unit)
    values = aligned(
        ["0" if v == s == 0.0 else rounded(float(v), float(s)) for v, s in zip(vector, u, strict=True)]
    )

    def column(sizes: Floats) -> list[str]:
        known = calibration.determined(sizes / scale.size).tolist()
        return aligned(["–" if math.isnan(size) else uncertainty(size) for size in known])

    of_readings, standard, expanded = map(column, (calibration.u_readings, u, calibration.U))
    groups: list[tuple[str, list[Row]]] = []
    for title, members in (
        (message("Scale factors"), [0, 4, 8]),
        (message("Cross-axis terms"), [1, 2, 3, 5, 6, 7]),
        (message("Biases"), [9, 10, 11]),
    ):
        others = aligned([_in_other_terms(calibration, j)[0] for j in members])
        rows = [
            Row(
                symbol(COEFFICIENTS[j]),
                values[j],
                base.unit if j >= 9 else base.per_g,
                of_readings[j],
                standard[j],
                expanded[j],
                scale.unit if j >= 9 else scale.per_g,
                other,
                _in_other_terms(calibration, j)[1],
            )
            for j, other in zip(members, others, strict=True)
        ]
        groups.append((title, rows))
    return groups


def _in_other_terms(calibration: Calibration, j: int) -> tuple[str, str]:
    """Return relative u (ppm) for a scale factor `j`, an angle (″) for a cross-axis term, g for a bias."""
    vector, u = calibration.block.vector, calibration.u
    own = 4 * (j // 3 if j < 9 else j - 9)
    if j == own:
        return uncertainty(abs(float(u[j] / vector[j])) * 1e6), "ppm"
    ratio, u_ratio = _ratio(calibration, j, own)
    if COEFFICIENTS[j] in calibration.zero_by_convention:
        return NOT_DETERMINED, ""
    if j < 9:
        return concise(ratio / ARCSEC, u_ratio / ARCSEC), "″"
    scale = scale_for(max(abs(ratio), u_ratio), "g")
    return concise(ratio / scale.size, u_ratio / scale.size), scale.unit


def _ratio(calibration: Calibration, j: int, own: int) -> tuple[float, float]:
    """Return coefficient `j` divided by coefficient `own`, and the u of this ratio from their covariance."""
    vector, covariance = calibration.block.vector, calibration.covariance
    ratio = vector[j] / vector[own]
    variance = covariance[j, j] + ratio**2 * covariance[own, own] - 2.0 * ratio * covariance[j, own]
    return float(ratio), float(np.sqrt(max(variance, 0.0)) / abs(vector[own]))


def nine(own: Intrinsic) -> list[Row]:
    """Return a row for each intrinsic number: value, its unit, u from the readings, u, U, unit of these three."""
    from bench.results.parts import shown_rows  # only the report needs it

    return [Row(symbol(name), *cells) for name, *cells in shown_rows(own)]


def strongest_correlations(calibration: Calibration) -> list[tuple[Markup, Markup, str]]:
    """Return the five pairs of coefficients with the largest |r|: both names, and r as text."""
    r = correlation_of(calibration.covariance)
    pairs = sorted(
        ((i, j) for i in range(12) for j in range(i)), key=lambda pair: (-abs(r[pair]), pair[1], pair[0])
    )
    return [
        (symbol(COEFFICIENTS[j]), symbol(COEFFICIENTS[i]), fixed(float(r[i, j]), 2, sign=True))
        for i, j in pairs[:5]
    ]


def comparison(calibration: Calibration, compared: Calibration) -> list[Row]:
    """Return a row for each coefficient: both estimates, their unit, their difference, and its unit."""
    difference = compared.block.vector - calibration.block.vector
    scale = scale_for(float(np.max(np.abs(difference))), calibration.unit)
    shown = [
        rounded(float(d) / scale.size, float(u) / scale.size, sign=True)
        for d, u in zip(difference, np.maximum(calibration.u, compared.u), strict=True)
    ]
    both = (
        [concise(v, u) for v, u in zip(c.block.vector.tolist(), c.u.tolist(), strict=True)]
        for c in (calibration, compared)
    )
    columns = (*both, shown)
    base = scale_for(1.0, calibration.unit)
    cells = list(zip(*(aligned(column) for column in columns), strict=True))
    return [
        Row(
            symbol(name),
            row[0], row[1], base.unit if j >= 9 else base.per_g, row[2], scale.unit if j >= 9 else scale.per_g
        )
        for j, (name, row) in enumerate(zip(COEFFICIENTS, cells, strict=True))
    ]  # fmt: skip


# --- stand and effects ------------------------------------------------------------------------------


def stand(calibration: Calibration) -> list[Row]:
    """Return a row for each stand angle: its meaning as heading, estimate, u, estimate/u, and a remark."""
    estimates = list(calibration.stand.values())
    pulls = [e.value / e.u if e.u > 0 else float("nan") for e in estimates]
    columns = (
        aligned([rounded(e.value, e.u, sign=True) for e in estimates]),
        aligned([uncertainty(e.u) for e in estimates]),
        aligned([fixed(pull, 1, sign=True) for pull in pulls]),
    )
    return [
        Row(_stand_angle(name), *cells, _in_words(pull, estimate))
        for (name, estimate), cells, pull in zip(
            calibration.stand.items(), zip(*columns, strict=True), pulls, strict=True
        )
    ]


def _stand_angle(name: str) -> Markup:
    """Return the label of a stand angle: "alpha3[2]" -> "α₃ mounting error, installation 2"."""
    parts = re.fullmatch(r"(?P<symbol>\w+)\[(?P<mount>.*)\]", name)
    if parts is None:
        return Markup("{}").format(name)
    of = parts["symbol"]
    meaning = {symbol: MEANINGS[angle] for angle, symbol in SYMBOLS.items()}.get(of, of)
    letter = (
        Markup("<i>α</i><sub>{}</sub> ").format(of.removeprefix("alpha")) if of.startswith("alpha") else ""
    )
    label = Markup(translated(message("{0}{1}, installation {2}")))  # noqa: S704 - our own text
    return label.format(letter, translated(meaning), parts["mount"])


def _in_words(pull: float, estimate: Estimate) -> str:
    if not np.isfinite(pull):
        return "–"
    if not estimate.told_by_data:
        return message("no better known than before")
    return message("differs from zero") if abs(pull) > SHOWS else message("not significant")


def effects(calibration: Calibration) -> list[Row]:
    """Return a row for each fitted parameter of the model's effects: estimate, u, unit, description."""
    rows = []
    for name, e in calibration.effects.items():
        known = CATALOGUE.get(name.replace(" ", ".").split(".")[0])
        unit = e.unit.replace("ug", "µg").replace("^2", "²").replace("^3", "³").replace("arcsec", "″")
        sentence = known.sentence if known else ""
        rows.append(Row(name, rounded(e.value, e.u, sign=True), uncertainty(e.u), unit, sentence))
    return rows


# --- verification and readings ----------------------------------------------------------------------


def verification(result: Verification) -> list[Row]:
    """Return a row for each verification point: angle, modulus, Δg, u, U, |Δg|/limit, risks, statement."""
    scale = scale_for(result.limit_g, "g")
    return [
        Row(
            numbers_in_words(p),
            f"{p.angle_deg:.4f}",
            rounded(p.g_p, p.u),
            rounded(p.delta_g / scale.size, p.u / scale.size, sign=True),
            uncertainty(p.u / scale.size),
            uncertainty(p.U / scale.size),
            f"{abs(p.delta_g) / result.limit_g:.0%}".replace("%", " %"),
            optional_probability(p.p_false_accept),
            optional_probability(p.p_false_reject),
            translated(str(p.statement), "statement"),
            bad=not p.passed,
        )
        for p in result.points
    ]


def free(calibration: Calibration) -> tuple[str, list[Row]] | None:
    """Return the unit of |a| - 1 g and a row for each free position in the fit; None without free positions."""
    of = calibration.free
    if of is None:
        return None
    scale = scale_for(float(np.max(np.abs(calibration.modulus_error))), "g")
    decimals = max(places(calibration.modulus_rms_g / scale.size), 0)
    return scale.unit, [
        Row(
            str(j + 1),
            str(of.installation[j]),
            str(of.pass_number[j]),
            str(of.point[j]),
            fixed(float(error) / scale.size, decimals, sign=True),
        )
        for j, error in enumerate(calibration.modulus_error)
    ]


def outliers(calibration: Calibration) -> list[Row]:
    """Return a row for each outlier: row number, place, channel, error, unit, error/u, weight in the fit."""
    return [
        Row(
            str(o.row),
            o.installation if o.series == 1 else f"{o.installation}/{o.series}",
            str(o.pass_number),
            str(o.point),
            o.channel,
            fixed(o.size, places(abs(o.size)), sign=True),
            o.unit,
            fixed(o.sigma, 1),
            f"{o.weight:g}",
        )
        for o in calibration.outliers
    ]


def readings(calibration: Calibration) -> tuple[str, list[Row]]:
    """Return the unit of the residuals, and a row for each fitted reading in the order of measurement."""
    if not len(calibration.fitted):
        return "", []
    fitted = calibration.fitted
    conditions = fitted.conditions()
    scale = residual_scale(calibration)
    signal_places = max(places(calibration.noise.reading), 0)
    residual_places = max(places(calibration.noise.reading / scale.size), 0)
    rows = []
    for j in range(len(fitted)):
        time_s, temperature_c = float(fitted.time_s[j]), float(fitted.temperature_c[j])
        rows.append(
            Row(
                str(j + 1),
                str(conditions.mounts[conditions.mount[j]]),
                str(fitted.pass_number[j]),
                str(fitted.point[j]),
                fixed(float(np.degrees(fitted.angle_rad[j])), 4),
                {1: "↑", -1: "↓"}.get(int(fitted.direction[j]), "–"),
                fixed(time_s, 0),
                fixed(temperature_c, 2),
                *(fixed(float(v), signal_places) for v in fitted.signal[j]),
                *(fixed(float(v) / scale.size, residual_places, sign=True) for v in calibration.residuals[j]),
            )
        )
    return scale.unit, rows


def sources(calibration: Calibration) -> dict[str, Any]:
    """Return rows and units of a table of sources that readings do not show, and u of gravity; {} if none."""
    if not calibration.sources:
        return {}
    largest = max(float(u_of(s.covariance).max()) for s in calibration.sources)
    scale = scale_for(largest, calibration.unit)
    rows = []
    for source in calibration.sources:
        u = u_of(source.covariance) / scale.size
        most = [float(u[own].max()) for own in ([0, 4, 8], [1, 2, 3, 5, 6, 7], [9, 10, 11])]
        origin = message(f"{source.origin} (prior)") if source.prior else source.origin
        cells = (source.size, *(uncertainty(size) if size >= HARDLY else "–" for size in most), origin)
        rows.append(Row(source.name.replace("_", " "), *cells))
    gravity = f"{calibration.gravity_u * 1e6:.2g} ppm" if calibration.gravity_u else ""
    return {"per_g": scale.per_g, "unit": scale.unit, "rows": rows, "gravity": gravity}


def noise(calibration: Calibration) -> dict[str, str]:
    """Return texts on the noise by name: standard deviations, their limits and source, and rms of the residuals."""
    of = calibration.noise
    limits = ""
    if of.setting_limits_rad is not None:
        low, high = (limit / ARCSEC for limit in of.setting_limits_rad)
        limits = message(f" (with 95 % between {low:.2g}″ and {high:.2g}″)")
    return {
        "reading": quantity(of.reading, calibration.unit),
        "setting": f"{uncertainty(of.setting_rad / ARCSEC)}″",
        "limits": limits,
        "dof": f"{of.dof:.0f}" if np.isfinite(of.dof) else "",
        "source": of.source,
        "each": ""
        if of.channels is None
        else ", ".join(
            f"{c} {quantity(size, calibration.unit)}" for c, size in zip(CHANNELS, of.channels, strict=True)
        ),
        "rms": quantity(calibration.lack_of_fit.rms, calibration.unit),
        "channels": ", ".join(CHANNELS),
    }


def page(name: str, **content: Any) -> str:
    """Render a template: content is escaped, control characters are shown, a missing variable is an error."""
    return visible(_templates(language()).get_template(name).render(**content))


@cache
def _templates(name: str) -> Environment:
    """Return the template environment of a language, cached so that each template is compiled only once."""
    environment = environment_for(name, "bench.results")
    environment.filters["shown_path"] = shown_path
    return environment
