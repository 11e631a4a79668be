"""The contents of a certificate's pages after the first: method, conditions, results, conformity, record."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, Final

from bench.base.arrays import ARCSEC
from bench.base.languages import language, local_number, translated
from bench.base.numbers import aligned, fixed, quantity, rounded, two_digits, typeset, uncertainty
from bench.base.text import visible
from bench.calibration.conformity import Statement
from bench.certificate.content import (
    Certificate,
    Condition,
    Instrument,
    RunFindings,
    Value,
    Values,
    rule_said,
    stated,
)
from bench.certificate.laboratory import in_each
from bench.results.plots import residuals_by_angle, verification_points
from bench.results.verification import numbers_in_words, optional_probability, probability_in_words

Block = dict[str, Any]
Cell = str | list[str] | dict[str, Any]

NOBODY_SAYS: Final = "–"
_MANY_DOF: Final = 1000
_CODE_LENGTH: Final = 32
"""Number of characters in each line of a hash."""


@dataclass(frozen=True)
class Writer:
    """A writer of page blocks in the languages of a certificate."""

    certificate: Certificate

    def say(self, key: str, **values: object) -> list[str]:
        """Return the text `key` in each language; a list in `values` has a wording for each language."""
        return in_each(self.certificate.texts, key, **values)

    def heading(self, key: str, level: int = 1) -> Block:
        """Return a heading block with the text `key`."""
        return {"kind": "heading", "words": self.say(key), "level": level}

    def words(self, key: str, **values: object) -> Block:
        """Return a paragraph block with the text `key`."""
        return {"kind": "words", "words": self.say(key, **values)}

    def pairs(self, rows: Iterable[tuple[str, Sequence[Cell]]]) -> Block:
        """Return a block of `rows` (key of the label, lines); a row without content shows a dash."""
        told = [[self.say(key), [one for one in lines if one] or [NOBODY_SAYS]] for key, lines in rows]
        return {"kind": "pairs", "rows": told}

    def stated(self, page: str) -> list[tuple[str, list[Cell]]]:
        """Return a page's rows from laboratory and order files; rows that are always printed come first."""
        fields = [one for one in self.certificate.stated if one.place.page == page]
        rows: list[tuple[str, list[Cell]]] = []
        for one in sorted(fields, key=lambda field: not field.place.otherwise):
            if one.texts:
                rows.append((one.key, [*one.texts]))
            elif one.place.otherwise:
                rows.append((one.key, [self.say(one.place.otherwise)]))
        return rows

    def table(
        self,
        head: Sequence[Cell],
        rows: Iterable[Sequence[Cell]],
        align: str,
        columns: Sequence[object],
        size: float = 8.8,
        *,
        whole: bool = False,
    ) -> Block:
        """Return a table block; a `whole` table stays on one page.

        For each column, `align` has "l" or "r", and `columns` has the width: "auto" or a fraction.
        """
        widths = [str(width) for width in columns]
        return {
            "kind": "table", "head": list(head), "rows": [list(row) for row in rows], "align": list(align),
            "columns": widths, "size": size, "whole": whole,
        }  # fmt: skip

    def figure(self, svg: str, key: str, width_mm: float, **values: object) -> Block:
        """Return a figure block from an inline SVG element; `key` is the key of the caption."""
        told = self.say(key, **values)
        alone = str(svg).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
        return {"kind": "figure", "svg": alone, "words": told, "width": width_mm, "alt": told[0]}


def symbol(name: str) -> dict[str, str]:
    """Return the cell for the symbol of a coefficient: K with its indices as subscripts."""
    if name.startswith("theta_"):
        return {"symbol": "θ", "index": name[6:]}
    if name.startswith("alpha_"):
        return {"symbol": "α", "index": name[6:]}
    return {"symbol": name[0], "index": name[1:]}


def value_cells(value: Value, size: float = 1.0, unit: str = "") -> list[Cell]:
    """Return a result's cells: name, value, U, k, degrees of freedom, unit.

    Value and U are divided by `size`, the magnitude of `unit` (empty: own unit) in the result's own unit.
    """
    U = value.U / size
    freedom = f"> {_MANY_DOF}" if value.dof > _MANY_DOF else fixed(value.dof, 0 if value.dof >= 10 else 1)
    exact = value.value == 0.0 and U == 0.0
    return [
        symbol(value.name),
        "0" if exact else rounded(value.value / size, U),
        uncertainty(U),
        f"{value.k:.4g}",
        "∞" if math.isinf(value.dof) else freedom,
        unit or value.unit.replace("deg", "°"),
    ]


def local(rows: Iterable[Sequence[Cell]]) -> list[list[Cell]]:
    """Return rows of results with the decimal sign of the certificate's main language."""

    def of(cell: Cell) -> Cell:
        if isinstance(cell, dict):
            return {name: local_number(text) if name == "part" else text for name, text in cell.items()}
        return local_number(cell) if isinstance(cell, str) else cell

    return [[of(cell) for cell in row] for row in rows]


def correlation_rows(values: Values) -> list[list[Cell]]:
    """Return the lower triangle of the correlation matrix, with dashes for results without uncertainty."""
    rows: list[list[Cell]] = []
    u = [value.u for value in values.values]
    for i, value in enumerate(values.values):
        cells: list[Cell] = [symbol(value.name)]
        for j in range(len(u)):
            if j > i:
                cells.append("")
            elif u[i] > 0.0 and u[j] > 0.0:
                cells.append("1" if i == j else fixed(float(values.covariance[i, j]) / (u[i] * u[j]), 3))
            else:
                cells.append(NOBODY_SAYS)
        rows.append(cells)
    return rows


def span(low: float, high: float, u: float | None, unit: str) -> str:
    """Return a range in words, such as "22.8 … 23.1 °C ± 0.2 °C (k = 2)"; without u, the range alone."""
    ends = [rounded(one, 2.0 * u) if u else fixed(one, 2) for one in (low, high)]
    text = f"{ends[0]} {unit}" if ends[0] == ends[1] else f"{ends[0]} … {ends[1]} {unit}"
    return local_number(f"{text} ± {uncertainty(2.0 * u)} {unit} (k = 2)" if u else text)


def days_in_words(days: tuple[date, date] | None) -> str:
    """Return the first and the last day, or one day if both coincide; empty if unknown."""
    return "" if days is None else " … ".join(dict.fromkeys(map(str, days)))


def plain(told: Any) -> Any:
    """Return data with control characters visible, so that no text on the page can hide another."""
    if isinstance(told, dict):
        return {name: plain(of) for name, of in told.items()}
    if isinstance(told, list | tuple):
        return [plain(of) for of in told]
    return re.sub(r"[\r\n\t]+", " ", visible(told)) if isinstance(told, str) else told


_FORMULA: Final = "U = K a + U₀,  a = N (U − U₀),  N = K⁻¹,  Δg = |a| − 1"
_RESULT_COLUMNS: Final = ["auto", 1.2, 1, 0.7, 0.8, 0.6]


def pages(write: Writer, attached: list[tuple[str, str]]) -> list[Block]:
    """Return the blocks of all pages but the first; `attached` has name and SHA-256 of each file."""
    found = write.certificate.found
    return [
        *_method(write),
        *_equipment(write),
        *_results(write),
        *_uncertainty(found, write),
        *_conformity(found, write),
        *_readings(found, write),
        *_record(write, attached),
        *_remarks(found, write),
    ]


# --- method, conditions and instruments ----------------------------------------------------------------


def _method(write: Writer) -> list[Block]:
    certificate = write.certificate
    found, order = certificate.found, certificate.order
    method = found.method
    procedure = method.procedure or write.say("procedure_unknown")
    told = {"procedure": procedure, "plan": method.plan_hash or NOBODY_SAYS, "estimator": method.estimator}
    rows: list[tuple[str, list[Cell]]] = [("formula", [_FORMULA]), *write.stated("method")]
    rows += [
        (key, [write.say(text, **blanks) for text, blanks in told])
        for key, told in certificate.origins.items()
    ]
    conditions = [_condition(one, write) for one in found.conditions]
    stated = (one for one in certificate.stated if one.place.page == "conditions" and one.texts)
    conditions += [[write.say(one.key), "; ".join(one.texts), NOBODY_SAYS] for one in stated]
    head: list[Cell] = [write.say("quantity"), write.say("value"), write.say("source")]
    return [
        write.heading("method"),
        write.words("method_text", model=method.model, **told),
        write.pairs(rows),
        *([] if order is None else [write.words("statement_supplied")]),
        write.heading("conditions"),
        write.table(head, conditions, "lll", [1, 1.3, 1.2]),
    ]


def _condition(one: Condition, write: Writer) -> list[Cell]:
    return [
        write.say(one.key, rail=one.about),
        span(one.low, one.high, one.u, one.unit),
        typeset(translated(one.source)) or NOBODY_SAYS,
    ]


def _equipment(write: Writer) -> list[Block]:
    found = write.certificate.found
    head = [write.say(key) for key in ("instrument", "identification", "certificate_of", "valid_until")]
    blocks = [
        write.heading("equipment"),
        write.table(
            head, [_instrument(one, write) for one in found.instruments], "llll", [0.9, 1.4, 1.6, 0.8]
        ),
    ]
    if reason := write.certificate.why_untraced:
        blocks.append(write.words("untraced_text", reason=reason))
    return [*blocks, write.words("traceability_text")]


def _instrument(one: Instrument, write: Writer) -> list[Cell]:
    held = one.certificate
    known = ", ".join(filter(None, (one.identity, one.serial if one.serial not in one.identity else "")))
    if held is None or one.foreign:
        return [one.name, known or NOBODY_SAYS, write.say("no_certificate"), NOBODY_SAYS]
    until = "" if held.valid_until is None else str(held.valid_until)
    expired = [f"{until} ({word})" for word in write.say("expired")]
    return [
        one.name,
        known or NOBODY_SAYS,
        f"{held.number}, {held.date}, {held.laboratory}",
        expired if one.expired else until or NOBODY_SAYS,
    ]


# --- results ------------------------------------------------------------------------------------------


def _results(write: Writer) -> list[Block]:
    certificate = write.certificate
    found, before = certificate.found, certificate.as_found
    blocks = [
        write.heading("results"),
        write.heading("coefficients", 2),
        _result_table(found, write, "coefficients"),
        write.words("uncertainty_text", k=f"{certificate.k:.4g}", coverage=certificate.coverage_percent),
        write.heading("correlations", 2),
        {**write.words("correlations_text"), "sticky": True},
        _correlations(found, write),
        write.heading("inverse", 2),
        write.words("inverse_text"),
        _result_table(found, write, "inverse"),
        write.heading("misalignments", 2),
        write.words("misalignments_text"),
        _result_table(found, write, "misalignments"),
        write.heading("intrinsic", 2),
        write.words("intrinsic_text"),
        _result_table(found, write, "intrinsic"),
    ]
    if before is not None:
        dated = write.pairs([("calibrated", [days_in_words(before.days)])])
        blocks += [write.heading("before"), _result_table(before, write, "coefficients"), dated]
        blocks += verdict_of(before, write)
    return blocks


def _result_table(found: RunFindings, write: Writer, which: str) -> Block:
    values = getattr(found, which).values
    head: list[Cell] = [write.say(key) for key in ("quantity", "value", "uncertainty", "k", "dof", "unit")]
    size, unit = (ARCSEC, "″") if which == "misalignments" else (1.0, "")
    rows = [value_cells(value, size, unit) for value in values]
    for column in (1, 2):  # align the decimal points of the values and of U
        shown = aligned([str(row[column]) for row in rows])
        for row, cell in zip(rows, shown, strict=True):
            row[column] = cell
    return write.table(head, local(rows), "lrrrrl", _RESULT_COLUMNS, whole=True)


def _correlations(found: RunFindings, write: Writer) -> Block:
    values = found.coefficients
    head: list[Cell] = ["", *(symbol(value.name) for value in values.values)]
    return write.table(
        head,
        local(correlation_rows(values)),
        "l" + "r" * len(values.values),
        ["auto"] + [1] * len(values.values),
        7.4,
        whole=True,
    )


def _uncertainty(found: RunFindings, write: Writer) -> list[Block]:
    head: list[Cell] = [write.say(key) for key in ("source", "size", "part", "origin")]
    rows: list[list[Cell]] = [
        [
            typeset(translated(one.name.replace("_", " "))),
            typeset(_to_two_digits(one.size)) or NOBODY_SAYS,
            {"part": _size(one.u, one.unit), **symbol(one.most_in)},
            {"lines": [typeset(translated(one.origin)), *([write.say("prior")] if one.prior else [])]},
        ]
        for one in found.contributions
    ]
    return [write.heading("budget"), write.table(head, local(rows), "llll", [1, 0.9, 0.9, 2])] if rows else []


def _to_two_digits(size: str) -> str:
    """Return the size of an error source, such as "8.29 µV", rounded to two digits."""
    number, _, unit = size.partition(" ")
    try:
        return f"{two_digits(float(number))} {unit}"
    except ValueError:
        return size


def _size(u: float, unit: str) -> str:
    """Return a size with a suitable SI prefix: "25 µV/g"."""
    top, slash, below = unit.partition("/")
    return quantity(u, top) + slash + below


# --- conformity ---------------------------------------------------------------------------------------


def verdict_of(found: RunFindings, write: Writer) -> list[Block]:
    """Return the blocks of the statement of conformity, made from a run's results."""
    result = found.verification
    if result is None:
        if found.result.accepted:
            return [write.words("no_conformity")]
        return [{**write.words(Statement.MISFIT.value), "strong": True}]
    statement = write.say(str(stated(result)[0]))
    told = write.words(
        "conformity_text",
        points=len(result.points), limit=typeset(f"{result.limit_g:g}"), statement=statement,
    )  # fmt: skip
    worst, scale = result.worst, 1e6
    error, U = (
        local_number(text)
        for text in (rounded(abs(worst.delta_g) * scale, worst.U * scale), uncertainty(worst.U * scale))
    )
    rows: list[tuple[str, list[Cell]]] = [
        ("delta_g", [f"max |Δg| = {error} µg, U = {U} µg (k = {local_number(f'{worst.k:.4g}')})"]),
        ("rule", [rule_said(write.say, result.decision)]),
    ]
    if result.missing:
        rows.append(("missing", [str(result.missing)]))
    if result.passed or result.left_open:
        rows.append(("p_false_accept", [local_number(probability_in_words(result.p_outside))]))
    elif result.rejected:
        rows.append(("p_false_reject", [local_number(probability_in_words(1.0 - result.p_outside))]))
    return [{**told, "strong": True}, write.pairs(rows)]


def _conformity(found: RunFindings, write: Writer) -> list[Block]:
    result = found.verification
    if result is None:
        return []
    scale = 1e6
    head: list[Cell] = [
        write.say("point"), write.say("angle"), "Δg / µg", "U / µg", "k", write.say("statement"),
        write.say("p_false_accept"),
    ]  # fmt: skip
    rows: list[list[Cell]] = [
        [
            numbers_in_words(p),
            f"{p.angle_deg:.4f}°",
            rounded(p.delta_g * scale, p.U * scale, sign=True),
            uncertainty(p.U * scale),
            f"{p.k:.4g}",
            write.say(str(statement)),
            optional_probability(p.p_false_accept),
        ]
        for p, statement in zip(result.points, stated(result)[1], strict=True)
    ]
    return [
        write.heading("conformity"),
        write.table(head, local(rows), "llrrrlr", [0.8, 1, 0.8, 0.7, 0.5, 1.1, 1.2], whole=len(rows) < 25),
        write.figure(_drawn(verification_points, result), "figure_points", 140.0),
    ]


def _readings(found: RunFindings, write: Writer) -> list[Block]:
    svg = _drawn(residuals_by_angle, found.result.calibration)
    return [write.heading("readings"), write.figure(svg, "figure_residuals", 150.0)]


_kept: dict[str, tuple[Any, str]] = {}


def _drawn(draw: Callable[[Any], str], of: Any) -> str:
    """Return the figure that `draw` makes; the latest of each kind is cached, as pages are typeset twice."""
    name = f"{draw.__name__} {language()}"
    kept = _kept.get(name)
    if kept is None or kept[0] is not of:
        _kept[name] = kept = (of, draw(of))
    return kept[1]


# --- record -------------------------------------------------------------------------------------------


def _record(write: Writer, attached: list[tuple[str, str]]) -> list[Block]:
    certificate = write.certificate
    record = certificate.found.record
    sealed = write.words("seal_text", sealed=record.sealed) if record.sealed else write.words("no_seal")
    signed = "unsigned" if certificate.unsigned else "signed_itself"
    head: list[Cell] = [write.say(key) for key in ("file", "description", "digest")]
    rows: list[list[Cell]] = []
    for name, digest in attached:  # name and hash are set in a monospaced font
        parts = [{"code": digest[at : at + _CODE_LENGTH]} for at in range(0, len(digest), _CODE_LENGTH)]
        rows.append([{"code": name}, write.say(name), {"lines": parts}])
    return [
        write.heading("record"),
        write.words("record_text", run=record.run, events=record.events, head=record.head),
        sealed,
        write.heading("attached"),
        *([] if certificate.draft else [write.words("attached_text", signed=write.say(signed))]),
        write.table(head, rows, "lll", ["auto", 1, "auto"]),
    ]


def _remarks(found: RunFindings, write: Writer) -> list[Block]:
    notes = [{"kind": "words", "words": [typeset(translated(note))]} for note in found.notes]
    return [*([write.heading("notes"), *notes] if notes else []), write.words("statement_recalibration")]
