"""What stands on a page, as data for the template: words in the languages asked for, numbers, never markup."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any, Final

from bench.base.numbers import fixed, rounded, uncertainty
from bench.base.visible import visible
from bench.certificate.content import Certificate, Value, Values

Block = dict[str, Any]
Cell = str | list[str] | dict[str, Any]

NOBODY_SAYS: Final = "–"
_MANY_DOF: Final = 1000
_CODE_LENGTH: Final = 32
"""Hashes are broken in parts of this length."""


class Writer:
    """Blocks in the languages of a certificate."""

    def __init__(self, certificate: Certificate) -> None:
        self._texts = certificate.texts

    def say(self, key: str, **values: object) -> list[str]:
        """Return a text in each language; a value that is words in each language is taken by language."""
        return [
            text.say(key, **{name: of[i] if isinstance(of, list) else of for name, of in values.items()})
            for i, text in enumerate(self._texts)
        ]

    def heading(self, key: str, level: int = 1) -> Block:
        """Return a heading."""
        return {"kind": "heading", "words": self.say(key), "level": level}

    def words(self, key: str, **values: object) -> Block:
        """Return a paragraph."""
        return {"kind": "words", "words": self.say(key, **values)}

    def pairs(self, rows: Iterable[tuple[str, Sequence[Cell]]]) -> Block:
        """Return lines behind names of them; what nobody says has a dash."""
        told = [[self.say(key), [one for one in lines if one] or [NOBODY_SAYS]] for key, lines in rows]
        return {"kind": "pairs", "rows": told}

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
        """Return a table: `align` has l or r for each column, `columns` "auto" or a share of the width.

        One that is `whole` stands on one page.
        """
        widths = [str(width) for width in columns]
        return {
            "kind": "table", "head": list(head), "rows": [list(row) for row in rows], "align": list(align),
            "columns": widths, "size": size, "whole": whole,
        }  # fmt: skip

    def figure(self, svg: str, key: str, width_mm: float, **values: object) -> Block:
        """Return a figure of the report: vectors, the lettering as outlines."""
        told = self.say(key, **values)
        alone = svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
        return {"kind": "figure", "svg": alone, "words": told, "width": width_mm, "alt": told[0]}


def symbol(name: str) -> Cell:
    """Return the name of a number as it is set: K with its indices below."""
    if name.startswith("alpha_"):
        return {"symbol": "α", "index": name[6:]}
    return {"symbol": name[0], "index": name[1:]}


def value_cells(value: Value, size: float = 1.0, unit: str = "") -> list[Cell]:
    """Return a row of a result in units of `size`: name, value, U, k, degrees of freedom, unit."""
    U = value.U / size
    freedom = (
        "∞"
        if math.isinf(value.dof)
        else f"> {_MANY_DOF}"
        if value.dof > _MANY_DOF
        else fixed(value.dof, 0 if value.dof >= 10 else 1)
    )
    exact = value.value == 0.0 and U == 0.0
    return [
        symbol(value.name),
        "0" if exact else rounded(value.value / size, U),
        uncertainty(U),
        f"{value.k:.3g}",
        freedom,
        unit or value.unit,
    ]


def correlation_rows(values: Values) -> list[list[Cell]]:
    """Return the lower triangle of the correlations, a row for each result; one without u has dashes."""
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


def code(text: str) -> Cell:
    """Return a hash, an address, a name of a file as it is set."""
    return {"code": text}


def broken(digest: str) -> list[Cell]:
    """Return a hash in lines."""
    return [code(digest[at : at + _CODE_LENGTH]) for at in range(0, len(digest), _CODE_LENGTH)]


def span(low: float, high: float, u: float | None, unit: str) -> str:
    """Return a range as a certificate states it: "22.8 °C to 23.1 °C", with U where there is one (k = 2)."""
    ends = [rounded(one, 2.0 * u) if u else fixed(one, 2) for one in (low, high)]
    text = f"{ends[0]} {unit}" if ends[0] == ends[1] else f"{ends[0]} … {ends[1]} {unit}"
    return f"{text} ± {uncertainty(2.0 * u)} {unit} (k = 2)" if u else text


def plain(told: Any) -> Any:
    """Return data without characters that act: what a name hides is seen on paper."""
    if isinstance(told, dict):
        return {name: plain(of) for name, of in told.items()}
    if isinstance(told, list | tuple):
        return [plain(of) for of in told]
    return re.sub(r"[\r\n\t]+", " ", visible(told)) if isinstance(told, str) else told
