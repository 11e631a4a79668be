"""The stored result of the trial (counts, as JSON), and its tables on the site."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.blind_trial.cases import Row
from benchmarks.blind_trial.score import NOT_SHRUNK, Outcome
from benchmarks.campaign import Share, markdown

STORED: Final = Path(__file__).parents[2] / "docs" / "blind-trial.json"

_HIDDEN: Final = {
    "null": "nothing",
    "slip": "the block turns in its mounting",
    "rezero": "the zero of the head shifts",
    "exchanged": "two meters are exchanged",
    "single": "one effect",
    "pair": "two effects of different subsystems",
    "outside": "an effect that the program does not know",
    "own": "an effect that a user's formula describes",
    "hidden": "an effect that the readings cannot show",
    "equal_k2": "the same quadratic term in all channels",
    "mounting_roll": "a roll of the block's mounting",
    "mistake": "a mistake of procedure or wiring",
    "other_psi": "the bench file states a wrong angle of the verification points",
    "common_volts": "a decaying voltage in all channels",
    "hand_set": "setting errors of 0.5°",
    "repaired": "a mistake and an effect",
    "supply": "an effect of the supply, or a drift beside a varying supply",
    "free": "free positions: nothing, an outlier or an effect",
}
"""What is hidden in each kind of case."""

_WORDS: Final = {
    "agrees": "verdict `agrees`",
    "mistake alleged": "verdict `mistake`",
    "no mistake alleged": "verdict not `mistake`",
    "mistake found": "verdict `mistake`",
    "flagged unknown": "verdict `unknown`",
    "flagged unknown (like a member)": "verdict `unknown` (like a known effect)",
    "refused": "verdict `unknown`",
    "alone given": "alone",
    "given a single name": "alone",
    "given a single name (like a member)": "alone (like a known effect)",
    "given a single name that leaves 4 to 7": "alone, 4 to 7 units unexplained",
    "given a single name that leaves 7 or more": "alone, 7 units or more unexplained",
    "detected (like a member)": "detected (like a known effect)",
    "detected (has a mean form)": "detected (same course in every run)",
    "nothing without it": "true name in every set",
    "a set without either": "a set with neither name",
    "the effect in the set": "effect in the set",
    "first name right": "first right",
    "one alleged": "one outlier named",
    "nothing else": "nothing else named",
    "contradiction told": "contradiction reported",
    "hidden listed": "listed as invisible",
    "points at the electrics": "an electrical effect named",
    "told from bias_drift": "separated from bias_drift",
    "told from supply_sensitivity": "separated from supply_sensitivity",
    "form closes 80 %": "form closes 80 % of what the true form closes",
    NOT_SHRUNK: "alone, gap not smaller",
}
"""What the page calls a column of the stored result, if it does not use the column's own name."""

Stored = dict[str, Any]


def stored(
    rows: Sequence[Row],
    shares: Mapping[str, Mapping[str, Share]],
    outcomes: Sequence[Outcome],
    made: Mapping[str, object],
) -> Stored:
    """Return the result to store: what made it (`made`), then the counts and the gap of each row."""
    return {**made, "cases": len(outcomes), "rows": [_row(row, shares[row.key], outcomes) for row in rows]}


def _row(row: Row, shares: Mapping[str, Share], outcomes: Sequence[Outcome]) -> Stored:
    return {
        "kind": row.kind.split(":")[0],
        "row": row.key,
        "rho": row.rho,
        "score": {column: [share.successes, share.of] for column, share in shares.items()},
        "gap": _gap(row, outcomes),
    }


def _gap(row: Row, outcomes: Sequence[Outcome]) -> Stored | None:
    """Return a row's mean reduced chi-square, before and after naming, on held-out readings, or None."""
    gaps = [
        outcome.diagnosis["gap"]
        for outcome in outcomes
        if outcome.task.row == row
        and outcome.diagnosis
        and outcome.diagnosis["verdict"] in {"named", "confounded"}
        and outcome.diagnosis["gap"]["p_after"] is not None
    ]
    if row.kind != "single" or not gaps:
        return None
    means = {when: round(float(np.mean([gap[when] for gap in gaps])), 3) for when in ("before", "after")}
    return {"cases": len(gaps), **means}


def part(result: Stored) -> str:
    """Return the part of the page: what made the result, sums over rows, and the tables."""
    size = f"{result['cases']:,} cases, {result['seconds']:,} s{result['on']}"
    made = f"Measured with `{result['command']}` ({size})."
    return "\n\n".join((made, sums(result), short_tables(result)))


def sums(result: Stored) -> str:
    """Return a table of the rows with a single effect, summed by size, and of the rates over all rows."""

    def sum_of(kind: str, column: str, low: float, high: float) -> str:
        counts = [
            row["score"][column]
            for row in result["rows"]
            if row["kind"] == kind and low <= (row["rho"] or 0.0) < high and column in row["score"]
        ]
        share = Share(sum(c[0] for c in counts), sum(c[1] for c in counts))
        return f"{share.successes}/{share.of}" if share.of else "–"

    columns = {
        "detected": "detected",
        "in the set": "in the set",
        "first right": "first name right",
        "alone right": "alone right",
    }
    lines = markdown(("single effect", *columns), (
        (named, *(sum_of("single", column, low, high) for column in columns.values()))
        for named, low, high in (("ρ ≥ 15", 15, np.inf), ("ρ ≥ 8", 8, np.inf), ("ρ = 5", 5, 5.5))
    ))  # fmt: skip
    agree = sum_of("null", "agrees", 0, np.inf)
    parts = ["\n".join(lines), f"With nothing hidden, the verdict is `agrees` in {agree} cases."]
    alone = [row["score"][NOT_SHRUNK] for row in result["rows"] if NOT_SHRUNK in row["score"]]
    if alone:
        larger = Share(sum(c[0] for c in alone), sum(c[1] for c in alone))
        parts.append(f"A single name was given, although the gap did not become smaller: {larger}.")
    return "\n\n".join(parts)


def short_tables(result: Stored) -> str:
    """Return the tables of the page; a line of text replaces a column that is equal in all rows of a kind."""
    first, parts = [], []
    for kind, of_kind in _by_kind(result).items():
        columns = _columns(of_kind)
        shares = {c: [Share(*row["score"][c]) for row in of_kind if c in row["score"]] for c in columns}
        same = [c for c in columns if {share.part for share in shares[c] if share.of} in ({0.0}, {1.0})]
        keys = [_within_kind(row) for row in of_kind]
        left = [c for c in columns if c not in same]
        counts = (
            f"{_word(c)} {sum(s.successes for s in shares[c])}/{sum(s.of for s in shares[c])}" for c in same
        )
        rows = len(keys) if left else "; ".join(keys)
        first.append((kind, _HIDDEN[kind], rows, "; ".join(counts)))
        if left:
            parts.append(_table([row for row in of_kind if set(left) & row["score"].keys()], left))
    heads = ("kind", "what is hidden", "rows", "the same in every row")
    return "\n\n".join(["\n".join(markdown(heads, first)), *parts])


def tables(result: Stored) -> str:
    """Return a table for each kind of case with every column, a line for each row."""
    return "\n\n".join(_table(rows, _columns(rows)) for rows in _by_kind(result).values())


def _by_kind(result: Stored) -> dict[str, list[Stored]]:
    kinds = dict.fromkeys(row["kind"] for row in result["rows"])
    return {kind: [row for row in result["rows"] if row["kind"] == kind] for kind in kinds}


def _columns(rows: Sequence[Stored]) -> list[str]:
    return list(dict.fromkeys(column for row in rows for column in row["score"]))


def _table(rows: Sequence[Stored], columns: Sequence[str]) -> str:
    """Return a table of the rows of a kind, with their gaps if they have any."""
    gaps = any(row["gap"] for row in rows)
    head = [rows[0]["kind"], *map(_word, columns), *(("gap before", "gap after") if gaps else ())]
    lines = []
    for row in rows:
        lines.append([_within_kind(row), *(Share(*row["score"].get(column, (0, 0))) for column in columns)])
        if gaps:
            lines[-1] += [f"{row['gap'][w]:.3f}" if row["gap"] else "–" for w in ("before", "after")]
    return "\n".join(markdown(head, lines))


def _word(column: str) -> str:
    return _WORDS.get(column, column)


def _within_kind(row: Stored) -> str:
    return str(row["row"]).removeprefix(row["kind"]).lstrip(" :")


def shown() -> str:
    """Return the tables of the stored result for the site."""
    return part(json.loads(STORED.read_text(encoding="utf-8")))


def write(result: Stored, stored_at: Path = STORED) -> None:
    """Store a result."""
    stored_at.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
