"""The trial's result as it is stored (counts, in JSON), and the part of docs/diagnosis-trial.md that is made of it.

python -m benchmarks.blind_trial.page          # write that part again from the stored result
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.blind_trial.cases import Row
from benchmarks.blind_trial.score import NOT_SHRUNK, Outcome
from benchmarks.campaign import Share

_DOCS: Final = Path(__file__).parents[2] / "docs"
PAGE: Final = _DOCS / "diagnosis-trial.md"
STORED: Final = _DOCS / "blind-trial.json"
BEGIN: Final = "<!-- begin: written by make blind-trial from blind-trial.json -->"
END: Final = "<!-- end -->"

Stored = dict[str, Any]


def stored(
    rows: Sequence[Row],
    shares: Mapping[str, Mapping[str, Share]],
    outcomes: Sequence[Outcome],
    made: Mapping[str, object],
) -> Stored:
    """Return the result to be stored: `made` says by what, then each row with its counts and its gap."""
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
    """Return the mean reduced chi-square of the readings held out, before and after naming; None without any."""
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
    """Return the part of the page: what made it, sums over rows, the tables."""
    size = f"{result['cases']:,} cases, {result['seconds']:,} s{result['on']}"
    made = f"Measured with `{result['command']}` ({size})."
    return "\n\n".join((made, *sums(result), tables(result)))


def sums(result: Stored) -> Iterator[str]:
    """Yield the sentences on rows of a kind taken together."""

    def sum_of(kind: str, column: str, low: float, high: float) -> str:
        counts = [
            row["score"][column]
            for row in result["rows"]
            if row["kind"] == kind and low <= (row["rho"] or 0.0) < high and column in row["score"]
        ]
        share = Share(sum(c[0] for c in counts), sum(c[1] for c in counts))
        return (
            f"{share.successes} of {share.of} ({share.successes / share.of:.3f})" if share.of else "none of 0"
        )

    for told, low, high in (("ρ ≥ 15", 15, np.inf), ("ρ ≥ 8", 8, np.inf), ("ρ = 5", 5, 5.5)):
        yield (
            f"All rows of {told} with a single effect taken together: "
            f"detected {sum_of('single', 'detected', low, high)}; "
            f"the true name in the set {sum_of('single', 'in the set', low, high)}; "
            f"the first name right where the data can tell {sum_of('single', 'first name right', low, high)}; "
            f"a name alone right {sum_of('single', 'alone right', low, high)}."
        )
    yield f"With nothing hidden, {sum_of('null', 'agrees', 0, np.inf)} agree."
    alone = [row["score"][NOT_SHRUNK] for row in result["rows"] if NOT_SHRUNK in row["score"]]
    if alone:
        larger = Share(sum(c[0] for c in alone), sum(c[1] for c in alone))
        yield f"Named in any row, with a gap on readings held out that is not smaller or not measured: {larger}."


def tables(result: Stored) -> str:
    """Return a table for each kind of case, a line for each row, and one of the gaps."""
    parts = []
    for kind in dict.fromkeys(row["kind"] for row in result["rows"]):
        of_kind = [row for row in result["rows"] if row["kind"] == kind]
        columns = list(dict.fromkeys(column for row in of_kind for column in row["score"]))
        lines = [f"| {kind} | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
        for row in of_kind:
            cells = [str(Share(*row["score"].get(column, (0, 0)))) for column in columns]
            lines.append(f"| {row['row']} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    gaps = [(row["row"], row["gap"]) for row in result["rows"] if row["gap"]]
    lines = ["| held out, named | cases | before | after |", "|---|---|---|---|"]
    lines += [f"| {name} | {g['cases']} | {g['before']:.3f} | {g['after']:.3f} |" for name, g in gaps]
    return "\n\n".join([*parts, "\n".join(lines)])


def current_part(page: Path = PAGE) -> str:
    """Return what stands on the page between the marks. Raises `ValueError` where they do not stand once."""
    before, _, rest = page.read_text(encoding="utf-8").partition(f"{BEGIN}\n\n")
    inside, mark, _ = rest.partition(f"\n\n{END}\n")
    if not before or not mark:
        raise ValueError(f"{page}: the marks of the blind trial's part are not there")
    return inside


def write(result: Stored, page: Path = PAGE, stored_at: Path = STORED) -> None:
    """Store a result and write its part of the page."""
    stored_at.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace(current_part(page), part(result)), encoding="utf-8")


if __name__ == "__main__":
    write(json.loads(STORED.read_text(encoding="utf-8")))
