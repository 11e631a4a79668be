"""Diagnose published records of real instruments, and compare u with the scatter of repeats.

python -m benchmarks.real_records            # tables of verdicts, names, sizes, gap, twins, and of repeats
    python -m benchmarks.real_records --page     # the same into docs/real-records.md; five minutes
    python -m benchmarks.real_records --seeds 20 # instead, 20 twins of each record; six minutes

The truth is what the publishers state (`truth.yaml`). It was sealed with the records by hash (`sealed.json`) before
the first run. A twin is a simulation with the times and temperatures of a record, and with the effects and noise
found in it: its diagnosis must give the same names and sizes (`benchmarks/real_records/twins.py`).
"""

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats, rms
from bench.base.numbers import quantity
from bench.diagnosis.free_positions import diagnose_free
from bench.diagnosis.free_records import FreeDiagnosis
from bench.diagnosis.record_calibration import calibrate_record
from bench.diagnosis.record_diagnosis import RecordDiagnosis, diagnose_record
from bench.readings.csv import read_csv
from bench.results.diagnosis_words import parameter_in_words
from bench.stats.repeats import Ratio, Repeats, compare_repeats
from benchmarks.campaign import arguments, markdown
from benchmarks.real_records.cases import ROOT, Case, cases, require_sealed
from benchmarks.real_records.twins import (
    FEWER,
    KNOWN,
    OTHER,
    SAME,
    TIE,
    judged,
    make_twins,
    names_of,
    sizes_off,
    twin_of,
)

PAGE: Final = ROOT / "docs/real-records.md"
JUMP: Final = "voltmeter_move"
WRONG, MISSED, UNTOLD = "wrong lone name", "missed", "a jump not published"
"""Words in the column `judged`."""


@dataclass(frozen=True)
class Row:
    """The outcome for a record: diagnoses of it and its twin, scatter of repeats before and after naming."""

    case: Case
    found: RecordDiagnosis | FreeDiagnosis
    twin: RecordDiagnosis | None
    before: Repeats | None
    after: Repeats | None

    @property
    def groups(self) -> list[list[str]]:
        """The possible names of each effect of the catalogue that was found; several names are a tie."""
        return [[one.name, *one.cannot_tell_from] for one in self.found.effects if one.in_catalogue]

    @property
    def judged(self) -> str:
        """Whether the names agree with the publisher's: right, missed, wrong, tie, or nothing to find.

        A jump does not count as a name, because it states when something happened, and not why.
        """
        right, alone = set(self.case.right), {group[0] for group in self.groups if len(group) == 1}
        if alone - right - {JUMP}:
            return WRONG
        if right and not any(right & set(group) for group in self.groups):
            return MISSED
        jumps = f", {UNTOLD}" if JUMP in alone - right else ""
        if right:
            return "right" + jumps
        return (
            "a tie, no cause published" if any(len(group) > 1 for group in self.groups) else "nothing named"
        ) + jumps

    @property
    def cells(self) -> list[str]:
        """The cells of the table of verdicts."""
        found, gap = self.found, self.found.gap
        sizes, held, rivals = [], "–", "–"
        if isinstance(found, RecordDiagnosis):
            sizes = [
                parameter_in_words(v, "").partition(" (")[0] for one in found.effects for v in one.parameters
            ]
            rivals = ", ".join(f"{r.what} {quantity(r.held_out_rms_v, 'V')}" for r in found.rivals) or "–"
        if gap.folds:
            unit = "V" if isinstance(found, RecordDiagnosis) else "g"
            held = f"{quantity(gap.before_rms, unit)} → {quantity(gap.after_rms, unit)}"
        names = "; ".join(" or ".join(group) for group in self.groups) or "none"
        told = self.case.told + (" ¹" if self.case.seen else "")
        return [
            self.case.title, told, found.verdict, names, self.judged, "; ".join(sizes) or "–", held, rivals,
            self.twin_in_words,
        ]  # fmt: skip

    @property
    def twin_in_words(self) -> str:
        """Whether the twin has the same names, and how far its sizes are from those put in, in its u."""
        if self.twin is None or not isinstance(self.found, RecordDiagnosis):
            return "–"
        word = judged(names_of(self.found), names_of(self.twin))
        off = sizes_off(self.found, self.twin).values()
        return f"{word}, sizes within {max(map(abs, off)):.1f} u" if word == SAME else word


def rows() -> Iterator[Row]:
    """Diagnose each record and its twin."""
    with tempfile.TemporaryDirectory() as folder:
        for case in cases():
            print(case.title, file=sys.stderr, flush=True)
            if case.free:
                free = diagnose_free([read_csv(file, ("1", "2", "V")) for file in case.files])
                between = None if free.between is None else free.between.repeats
                yield Row(case, free, None, between, None)
                continue
            readings = case.readings(Path(folder))
            found = diagnose_record(readings)
            twin = diagnose_record(twin_of(readings, found)) if found.applied else None
            before = calibrate_record(readings).repeats
            again = [replace(one, u={}) for one in found.applied]
            after = calibrate_record(readings, again).repeats if again else None
            yield Row(case, found, twin, before, after)


def twins(seeds: int) -> str:
    """Return the table of many twins of each record with effects, in Markdown."""
    headings = [
        "record", "twins", SAME, TIE, FEWER, OTHER, f"{SAME}, noise known", "ln of the odds: record; twins",
        "sizes, rms of (found − true) / u", "within 2 u",
    ]  # fmt: skip
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for case in cases():
            if case.free or not (found := diagnose_record(readings := case.readings(Path(folder)))).applied:
                continue
            print(case.title, file=sys.stderr, flush=True)
            made = make_twins(readings, found, seeds)
            known = "–" if made.known is None else f"{made.known[SAME]} of {KNOWN}"
            near = int(np.sum(np.abs(made.off) <= 2.0))
            counts = (str(made.names[word]) for word in (SAME, TIE, FEWER, OTHER))
            odds = "–" if made.odds is None else _odds(*made.odds)
            lines.append(
                [
                    case.title,
                    str(seeds),
                    *counts,
                    known,
                    odds,
                    f"{rms(made.off):.2f}",
                    f"{near} of {made.off.size}",
                ]
            )
    return "\n".join(markdown(headings, lines))


def _odds(record: float, twins: Floats, limit: float) -> str:
    share = np.mean(twins > limit)
    return f"{record:.2f}; {twins.mean():.1f} ± {twins.std():.1f}, {share:.0%} above {limit:.1f}"


def verdicts(found: Sequence[Row]) -> str:
    """Return the table of verdicts in Markdown, with the counts below."""
    headings = [
        "record", "published", "verdict", "names", "judgement", "sizes", "held out, rms", "with each shape", "twin",
    ]  # fmt: skip
    judged = [row.judged for row in found]
    counts = (
        f"A single name that is wrong: {judged.count(WRONG)} of {len(found)} records; effects missed: "
        f"{judged.count(MISSED)} of {sum(bool(row.case.right) for row in found)}; jumps not published: "
        f"{sum(UNTOLD in one for one in judged)}."
    )
    return "\n".join([*markdown(headings, [row.cells for row in found]), "", counts])


def repeats(found: Sequence[Row]) -> str:
    """Return the table of repeats in Markdown."""
    headings = ["set", "state", "scatter / u", "ratio, u as stated", "term", "ratio, with the term"]
    listed: list[tuple[str, str, Repeats | None]] = []
    for row in found:
        listed += [
            (row.case.title, "before naming", row.before),
            (row.case.title, "after naming", row.after),
        ]
    betweens = [one for row in found if isinstance(row.found, FreeDiagnosis) and (one := row.found.between)]
    pooled = compare_repeats(
        *(np.concatenate([getattr(b, name) for b in betweens]) for name in ("zero", "u"))
    )
    listed.append(("MIMU board, the four sensors pooled", "before naming", pooled))
    lines = [
        [
            title, state, f"{one.scatter:.2g}", _ratio(one.held_before), "–" if one.term is None else one.term.name,
            _ratio(one.held_after),
        ]
        for title, state, one in listed
        if one is not None
    ]  # fmt: skip
    return "\n".join(markdown(headings, lines))


def _ratio(of: Ratio | None) -> str:
    return "–" if of is None else f"{of.value:.2g} ({of.low:.2g} to {of.high:.2g})"


def main() -> None:
    asked = arguments(
        __doc__, page=(False, "write docs/real-records.md"),
        seeds=(0, "instead, diagnose this many twins of each record"),
    )  # fmt: skip
    require_sealed()
    if asked.seeds:
        made = {"twins": twins(asked.seeds)}
    else:
        found = list(rows())
        made = {"records": verdicts(found), "repeats": repeats(found)}
    if not asked.page:
        print("\n\n".join(made.values()))
        return
    text = PAGE.read_text(encoding="utf-8")
    for name, table in made.items():
        seeds = f"--seeds {asked.seeds} " if asked.seeds else ""
        begin = f"<!-- {name}: made by python -m benchmarks.real_records {seeds}--page -->"
        end = f"<!-- end of the {name} -->"
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}\n\n{table}\n\n{end}{rest.partition(end)[2]}"
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
