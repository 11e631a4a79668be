"""The pages that prove: method, conditions, instruments, results with their covariance, conformity, the record."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from bench.analysis.calibration.verdict_words import optional_probability, probability_in_words
from bench.base.arrays import ARCSEC
from bench.base.numbers import aligned, quantity, rounded, two_digits, typeset, uncertainty
from bench.certificate.content import (
    Certificate,
    Condition,
    Found,
    Instrument,
    rule_said,
    stated,
    uncertified,
)
from bench.certificate.paper.blocks import (
    NOBODY_SAYS,
    Block,
    Cell,
    Writer,
    broken,
    code,
    correlation_rows,
    span,
    symbol,
    value_cells,
)
from bench.report.plots import residuals_by_angle, verification_points

_FORMULA: Final = "U = K a + U₀,  a = N (U − U₀),  N = K⁻¹,  Δg = |a| − 1"
_RESULT_COLUMNS: Final = ["auto", 1.2, 1, 0.7, 0.8, 0.6]


def pages(certificate: Certificate, write: Writer, attached: list[tuple[str, str, str]]) -> list[Block]:
    """Return all that stands after the first page; `attached` are names, contents, hashes of files."""
    found = certificate.found
    return [
        *_method(certificate, write),
        *_equipment(certificate, write),
        *_results(certificate, write),
        *_uncertainty(found, write),
        *_conformity(found, write),
        *_readings(found, write),
        *_record(certificate, write, attached),
        *_remarks(certificate, write),
    ]


# --- how --------------------------------------------------------------------------------------------


def _method(certificate: Certificate, write: Writer) -> list[Block]:
    found, unit, order = certificate.found, certificate.unit, certificate.order
    method = found.method
    procedure = method.procedure or write.say("procedure_unknown")
    told = {"procedure": procedure, "plan": method.plan_hash or NOBODY_SAYS, "estimator": method.estimator}
    deviations: list[Cell] = [write.say("no_deviations")]
    if unit is not None and unit.deviations:
        deviations = [*unit.deviations]
    rows: list[tuple[str, list[Cell]]] = [("formula", [_FORMULA]), ("deviations", deviations)]
    if unit is not None and unit.adjusted is not None:
        rows.append(("adjusted", [unit.adjusted.what]))
    if order is not None and order.agreed:
        rows.append(("agreed", [*order.agreed]))
    rows += [
        (key, [write.say(text, **blanks) for text, blanks in told])
        for key, told in certificate.origins.items()
    ]
    return [
        write.heading("method"),
        write.words("method_text", model=method.model, **told),
        write.pairs(rows),
        *([] if order is None else [write.words("statement_supplied")]),
        write.heading("conditions"),
        write.table(
            [write.say("quantity"), write.say("value"), write.say("source")],
            [_condition(one, write) for one in found.conditions] + _environment(certificate, write),
            "lll", [1, 1.3, 1.2],
        ),
    ]  # fmt: skip


def _condition(one: Condition, write: Writer) -> list[Cell]:
    return [
        write.say(one.key, rail=one.about),
        span(one.low, one.high, one.u, one.unit),
        typeset(one.source) or NOBODY_SAYS,
    ]


def _environment(certificate: Certificate, write: Writer) -> list[list[Cell]]:
    stated = None if certificate.laboratory is None else certificate.laboratory.environment
    return [[write.say("environment"), stated, NOBODY_SAYS]] if stated else []


def _equipment(certificate: Certificate, write: Writer) -> list[Block]:
    found, order = certificate.found, certificate.order
    head = [write.say(key) for key in ("instrument", "identification", "certificate_of", "valid_until")]
    blocks = [
        write.heading("equipment"),
        write.table(
            head, [_instrument(one, write) for one in found.instruments], "llll", [0.9, 1.4, 1.6, 0.8]
        ),
    ]
    if uncertified(found):
        reason = None if order is None else order.without_certificates
        blocks.append(write.words("untraced_text", reason=reason or ", ".join(uncertified(found))))
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


# --- what was found -----------------------------------------------------------------------------------


def _results(certificate: Certificate, write: Writer) -> list[Block]:
    found, before = certificate.found, certificate.as_found
    coverage = f"{100.0 * certificate.coverage:.2f}".rstrip("0").rstrip(".")
    blocks = [
        write.heading("results"),
        write.heading("coefficients", 2),
        _result_table(found, write, "coefficients"),
        write.words("uncertainty_text", k=f"{certificate.k:.3g}", coverage=coverage),
        write.heading("correlations", 2),
        {**write.words("correlations_text"), "sticky": True},
        _correlations(found, write),
        write.heading("inverse", 2),
        _result_table(found, write, "inverse"),
        write.heading("misalignments", 2),
        _result_table(found, write, "misalignments"),
    ]
    if before is not None:
        blocks += [write.heading("before"), _result_table(before, write, "coefficients")]
        blocks += verdict_of(before, write)
    return blocks


def _result_table(found: Found, write: Writer, which: str) -> Block:
    values = getattr(found, which).values
    head: list[Cell] = [write.say(key) for key in ("quantity", "value", "uncertainty", "k", "dof", "unit")]
    size, unit = (ARCSEC, "″") if which == "misalignments" else (1.0, "")
    rows = [value_cells(value, size, unit) for value in values]
    for column in (1, 2):  # the value and U stand with their decimal points in line
        shown = aligned([str(row[column]) for row in rows])
        for row, cell in zip(rows, shown, strict=True):
            row[column] = cell
    return write.table(head, rows, "lrrrrl", _RESULT_COLUMNS, whole=True)


def _correlations(found: Found, write: Writer) -> Block:
    values = found.coefficients
    head: list[Cell] = ["", *(symbol(value.name) for value in values.values)]
    return write.table(
        head,
        correlation_rows(values),
        "l" + "r" * len(values.values),
        ["auto"] + [1] * len(values.values),
        7.4,
        whole=True,
    )


def _uncertainty(found: Found, write: Writer) -> list[Block]:
    head: list[Cell] = [write.say(key) for key in ("source", "size", "part", "origin")]
    rows: list[list[Cell]] = [
        [
            typeset(one.name.replace("_", " ")),
            typeset(_to_two_digits(one.size)),
            {"part": _size(one.u, one.unit), **_as_symbol(one.most_in)},
            {"lines": [typeset(one.origin), *([write.say("prior")] if one.prior else [])]},
        ]
        for one in found.contributions
    ]
    return [write.heading("budget"), write.table(head, rows, "llll", [1, 0.9, 0.9, 2])] if rows else []


def _to_two_digits(size: str) -> str:
    """Return the size of a source of error, "8.29 µV", as a page has it."""
    number, _, unit = size.partition(" ")
    try:
        return f"{two_digits(float(number))} {unit}"
    except ValueError:
        return size


def _size(u: float, unit: str) -> str:
    """Return a size with the prefix that reads best: "25 µV/g"."""
    top, slash, below = unit.partition("/")
    return quantity(u, top) + slash + below


def _as_symbol(name: str) -> dict[str, str]:
    told = symbol(name)
    assert isinstance(told, dict)  # noqa: S101 - the name of a coefficient
    return told


# --- conformity ---------------------------------------------------------------------------------------


def verdict(certificate: Certificate, write: Writer) -> list[Block]:
    """Return the statement of conformity as the first page has it."""
    return verdict_of(certificate.found, write)


def verdict_of(found: Found, write: Writer) -> list[Block]:
    """Return the statement of conformity on what a run found."""
    result = found.verification
    if result is None:
        return [write.words("no_conformity")]
    statement = write.say(str(stated(result)[0]))
    told = write.words(
        "conformity_text",
        points=len(result.points), limit=typeset(f"{result.limit_g:g}"), statement=statement,
    )  # fmt: skip
    worst, scale = result.worst, 1e6
    error, U = rounded(abs(worst.delta_g) * scale, worst.U * scale), uncertainty(worst.U * scale)
    rows: list[tuple[str, list[Cell]]] = [
        ("delta_g", [f"|Δg| ≤ {error} µg, U = {U} µg"]),
        (
            "rule",
            [rule_said(write.say, result.decision)],
        ),
    ]
    if result.missing:
        rows.append(("missing", [str(result.missing)]))
    if result.passed or result.left_open:
        rows.append(("p_false_accept", [probability_in_words(result.p_outside)]))
    elif result.rejected:
        rows.append(("p_false_reject", [probability_in_words(1.0 - result.p_outside)]))
    return [{**told, "strong": True}, write.pairs(rows)]


def _conformity(found: Found, write: Writer) -> list[Block]:
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
            f"{p.pass_number} / {p.point}",
            f"{p.angle_deg:.4f}°",
            rounded(p.delta_g * scale, p.U * scale, sign=True),
            uncertainty(p.U * scale),
            f"{p.k:.3g}",
            write.say(str(statement)),
            optional_probability(p.p_false_accept),
        ]
        for p, statement in zip(result.points, stated(result)[1], strict=True)
    ]
    return [
        write.heading("conformity"),
        write.table(head, rows, "llrrrlr", [0.8, 1, 0.8, 0.7, 0.5, 1.1, 1.2], whole=len(rows) < 25),
        write.figure(_drawn(verification_points, result), "figure_points", 140.0),
    ]


def _readings(found: Found, write: Writer) -> list[Block]:
    svg = _drawn(residuals_by_angle, found.result.calibration)
    return [write.heading("readings"), write.figure(svg, "figure_residuals", 150.0)]


_kept: dict[str, tuple[Any, str]] = {}


def _drawn(draw: Callable[[Any], str], of: Any) -> str:
    """Return a figure; the last one of each kind is kept, for the page is set unsigned and again signed."""
    kept = _kept.get(draw.__name__)
    if kept is None or kept[0] is not of:
        _kept[draw.__name__] = kept = (of, draw(of))
    return kept[1]


# --- what it rests on ---------------------------------------------------------------------------------


def _record(certificate: Certificate, write: Writer, attached: list[tuple[str, str, str]]) -> list[Block]:
    record = certificate.found.record
    sealed = [write.words("seal_text", sealed=record.sealed)] if record.sealed else [write.words("no_seal")]
    head: list[Cell] = [write.say(key) for key in ("file", "description", "digest")]
    rows: list[list[Cell]] = [
        [code(name), contents, {"lines": broken(digest)}] for name, contents, digest in attached
    ]
    return [
        write.heading("record"),
        write.words("record_text", run=record.run, events=record.events, head=record.head),
        *sealed,
        write.heading("attached"),
        *(
            []
            if certificate.draft
            else [
                write.words(
                    "attached_text", signed=write.say("unsigned" if certificate.unsigned else "signed_itself")
                )
            ]
        ),
        write.table(head, rows, "lll", ["auto", 1, "auto"]),
    ]


def _remarks(certificate: Certificate, write: Writer) -> list[Block]:
    found = certificate.found
    notes = [{"kind": "words", "words": [typeset(note)]} for note in found.notes]
    return [*([write.heading("notes"), *notes] if notes else []), write.words("statement_recalibration")]
