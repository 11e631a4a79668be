"""Records of real meters that strangers published, their nulls, and twins: what the diagnosis says of each.

    python -m benchmarks.real_records            # a table of verdicts, names, sizes, gap; about a minute
    python -m benchmarks.real_records --page     # the same into docs/real-records.md

What a record should give is what its publisher says of it and what a plain least-squares fit by its own code shows.
Nobody who works on this program chose the effects. A twin has the same times and temperatures, and the signal that
the simulation gives with what was found; its diagnosis must give the same name.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.numbers import quantity
from bench.config.foreign_log import LogColumns, convert_log
from bench.diagnosis.record_diagnosis import RecordDiagnosis, diagnose_record
from bench.diagnosis.record_model import Courses, Whitening, make_record
from bench.diagnosis.record_search import RecordWork
from bench.readings.csv import read_csv
from bench.readings.table import Readings
from bench.results.diagnosis_words import parameter_in_words

DATA = Path(__file__).parents[1] / "tests/data/known-input"
PAGE = Path(__file__).parents[1] / "docs/real-records.md"
BEGIN, END = (
    "<!-- records: made by python -m benchmarks.real_records --page -->",
    "<!-- end of the records -->",
)
SEED = 11
THERMAL = frozenset({"voltmeter_thermal_gain", "voltmeter_thermal_offset"})


@dataclass(frozen=True)
class Case:
    """A record: its log, the columns taken, and the names that are right; without names nothing is to be found."""

    title: str
    log: str
    columns: Mapping[str, Any]
    right: frozenset[str]
    constants: Mapping[str, str] | None = None


def _bath(title: str, reference: Any, signals: Sequence[str], warm: str, right: frozenset[str]) -> Case:
    columns = {"time_s": "time_s", "reference_v": reference, "meter_temperature_c": warm}
    columns |= {f"u{axis}_v": signal for axis, signal in zip("xyz", signals, strict=False)}
    return Case(title, "meter-in-air-bath-1v.csv", columns, right)


REFERENCES = ["k1_v", "k2_v", "k3_v"]
BATH = "dut_temperature_c"
MOVED = THERMAL | {"voltmeter_move"}
CASES = (
    _bath("34420A in an air bath, both inputs", REFERENCES, ["dut1_v", "dut2_v"], BATH, MOVED),
    _bath("the same, input 1", REFERENCES, ["dut1_v"], BATH, THERMAL),
    _bath("the same, input 2", REFERENCES, ["dut2_v"], BATH, MOVED),
    *(
        _bath(f"3458A {one[:2]} against {other[:2]}, no effect of the bath", other, [one], BATH, frozenset())
        for one, other in (("k1_v", "k2_v"), ("k2_v", "k3_v"), ("k3_v", "k1_v"))
    ),
    Case(
        "LTZ1000 reference, its supply swept",
        "reference-supply-swept.csv",
        {
            "time_s": "time_s", "ux_v": {"columns": "difference_uv", "unit": "uV"}, "rail_supply_v": "supply_v",
            "room_c": "room_c",
        },
        frozenset({"reference_supply"}),
        {"reference_v": "0.0175"},
    ),
)  # fmt: skip


def readings_of(case: Case, folder: Path) -> Readings:
    """Return the readings of a record, through a readings file."""
    constants = {"installation": "R", **(case.constants or {})}
    mapping = LogColumns.model_validate({"log_columns": "1", "columns": case.columns, "constants": constants})
    log = DATA / case.log
    file = folder / "record.csv"
    file.write_text(convert_log(log, log.read_bytes(), mapping).text, encoding="utf-8")
    return read_csv(file, ())


def twin_of(readings: Readings, found: RecordDiagnosis) -> Readings:
    """Return readings at the same times with the signal of what was found, and noise drawn as it was fitted."""
    rng = np.random.default_rng(SEED)
    record = make_record(readings)
    work = RecordWork(record, Courses(()), Whitening.of(record))
    noise = np.column_stack([work.drawn(one, rng, 1)[:, 0] for one in found.noises])
    noise = noise @ work.helmert * record.scale[:, None]
    added = np.sum([record.added(one) for one in found.applied], axis=0)
    at_h = (readings.time_s - record.conditions.elapsed_s[0]) / 3600.0
    scatter = np.sqrt(found.noises[0].variance * len(readings) / len(record))
    signal = np.full(readings.signal.shape, np.nan)
    for number, fit in enumerate(found.fits):
        course = record.reference_v + fit.zero_v + added[:, number] + noise[:, number]
        level = np.interp(at_h, record.time_h, course)
        signal[:, record.channels[number]] = level + rng.normal(0.0, scatter, len(readings))
    reference = np.interp(at_h, record.time_h, record.reference_v)
    extra = {**readings.extra, "reference_v": np.array([repr(v) for v in reference.tolist()])}
    return replace(readings, signal=signal, extra=extra)


@dataclass(frozen=True)
class Row:
    """What came of a record: its verdict, the names with their sizes, the gap, and the names of its twin."""

    case: Case
    found: RecordDiagnosis
    twin: RecordDiagnosis | None

    @property
    def names(self) -> list[str]:
        """The names, ties joined by "or"."""
        return [
            " or ".join([one.name, *one.cannot_tell_from]) for one in self.found.effects if one.in_catalogue
        ]

    @property
    def wrong(self) -> bool:
        """Whether a name stands alone that is not right."""
        alone = [one.name for one in self.found.effects if one.in_catalogue and not one.cannot_tell_from]
        return any(name not in self.case.right for name in alone)

    @property
    def cells(self) -> list[str]:
        """The cells of the table."""
        found = self.found
        sizes = [
            parameter_in_words(v, "").partition(" (")[0] for one in found.effects for v in one.parameters
        ]
        gap = found.gap
        held = f"{quantity(gap.before_rms, 'V')} → {quantity(gap.after_rms, 'V')}" if gap.folds else "–"
        rivals = ", ".join(f"{r.what} {quantity(r.held_out_rms_v, 'V')}" for r in found.rivals)
        twin = "–" if self.twin is None else ("same" if _names(self.twin) == _names(found) else "other")
        return [
            self.case.title, found.verdict, "; ".join(self.names) or "none", "; ".join(sizes) or "–", held,
            rivals or "–", twin,
        ]  # fmt: skip


def _names(found: RecordDiagnosis) -> set[frozenset[str]]:
    return {frozenset({one.name, *one.cannot_tell_from}) for one in found.effects}


def rows() -> Iterator[Row]:
    """Diagnose each record and its twin."""
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES:
            readings = readings_of(case, Path(folder))
            found = diagnose_record(readings)
            twin = diagnose_record(twin_of(readings, found)) if found.applied else None
            yield Row(case, found, twin)


HEADINGS = ["record", "verdict", "names", "sizes", "excursions held out, rms", "by kind of shape", "twin"]


def table(found: Sequence[Row]) -> str:
    """Return the table in Markdown, with the count of wrong lone names below."""
    lines = [f"| {' | '.join(HEADINGS)} |", f"|{'---|' * len(HEADINGS)}"]
    lines += [f"| {' | '.join(row.cells)} |" for row in found]
    wrong = sum(row.wrong for row in found)
    return "\n".join([*lines, "", f"Lone names that are wrong: {wrong} of {len(found)} records."])


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--page", action="store_true", help="write docs/real-records.md")
    arguments = parser.parse_args()
    made = table(list(rows()))
    if not arguments.page:
        print(made)
        return
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
