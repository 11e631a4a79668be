"""The calibration of meters from a record at a known input, as `bench calibrate` and `bench report` give it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from bench.base.arrays import CHANNELS
from bench.base.files import write_whole
from bench.base.tables import as_text
from bench.calibration.budget.sources import meter_gain_sources, unread_sources
from bench.calibration.result import CalibrationError
from bench.diagnosis.record_calibration import RecordCalibration, calibrate_record
from bench.history.stability import Stability, StaticRecord, on_grid, stability_of
from bench.results.record_calibration import (
    print_record_calibration,
    record_calibrate_result,
    render_record_calibration,
)
from bench.run.events import writing
from bench.services.source import Source, provenance

OF_METERS: Final = (
    "a record at a known input is of the meters, not of a block at rest; let a reading of a meter average as long "
    "as its averaging time above"
)


@dataclass(frozen=True, repr=False)
class RecordCalibrationResult:
    """Gain and offset of each channel, with u, from a record at a known input."""

    source: Source
    calibration: RecordCalibration

    @property
    def bench(self) -> str:
        """The name of the bench file, with the reason for it."""
        return self.source.taken.words

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader of the result, a sentence each."""
        readings = self.source.readings
        return (*self.calibration.notes, *readings.notes, *readings.skipped)

    @property
    def accepted(self) -> bool:
        """Always true: a record at a known input is not judged against a limit."""
        return True

    strictly_accepted = accepted

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench calibrate --json` writes it."""
        source = self.source
        return record_calibrate_result(
            self.calibration, source.model.name, source.readings.skipped, source.made_from()
        ).to_dict()

    def html(self) -> str:
        """Return the report as a page, with the stability of the residuals."""
        noise: Stability | str
        try:
            noise = meters_at_rest(self.source, self.calibration)
        except CalibrationError as reason:
            noise = str(reason)
        return render_record_calibration(
            self.calibration, noise, f"Calibration of {self.source.name}", provenance(self.source), self.notes,
            simulated=self.source.simulated,
        )  # fmt: skip

    def report(self, path: str | Path) -> None:
        """Write the report as one self-contained HTML page. Raises `RecordError`."""
        with writing(path) as file:
            write_whole(file, self.html())

    def print_on(self, out: Console) -> None:
        """Print gain, offset and drift of each channel, and the notes."""
        print_record_calibration(self.source.name, self.calibration, self.notes, out)

    def __repr__(self) -> str:
        """Return the output of `bench calibrate`, with the bench file that was used."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"


def record_calibration_of(source: Source) -> RecordCalibrationResult:
    """Calibrate meters at a known input, corrected for the model's effects. Raises `CalibrationError`."""
    hidden = (
        *unread_sources(source.bench, source.model), *meter_gain_sources(source.bench, source.traced.day)
    )  # fmt: skip
    return RecordCalibrationResult(source, calibrate_record(source.readings, source.model.effects, hidden))


def meters_at_rest(source: Source, found: RecordCalibration) -> Stability:
    """Return noise and drift of the residuals of meters at a known input. Raises `CalibrationError`."""
    bench, record = source.bench, of_meters(source, found)
    stable = stability_of(
        record, record.interval_s, None, bench.line_frequency, bench.nplc_supported, bench.most_samples
    )
    return replace(stable, advice=None, no_advice=OF_METERS)


def of_meters(source: Source, found: RecordCalibration) -> StaticRecord:
    """Return the residuals of meters at a known input, without outliers, as a static record.

    Gain, offset and the model's effects are subtracted.
    """
    readings, used = source.readings, found.record.used
    channels = tuple(CHANNELS[i] for i in found.record.channels)
    made = on_grid(source.name, readings.time_s[used], found.residual_of(readings)[used], channels)
    told = "signal less gain, reference, offset" + ", effects of the model" * bool(source.model.effects)
    return replace(made, notes=(f"{told}: what the meters add to a known input", *found.notes, *made.notes))
