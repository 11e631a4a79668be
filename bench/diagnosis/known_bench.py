"""What is known of a bench, and the effects that it therefore cannot have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from bench.base.languages import message
from bench.config.bench_file.file import BenchFile
from bench.model.effects import CATALOGUE
from bench.readings.columns import METER_C, ROOM_C, meter_c
from bench.readings.table import Readings

OF_METER_WARMTH: Final = ("voltmeter_thermal_gain", "voltmeter_thermal_offset")
NO_METER_C: Final = message(f"the readings have no column {METER_C} or {ROOM_C}")
OF_RECORDS: Final = ("voltmeter_move", "reference_supply")


@dataclass(frozen=True)
class KnownBench:
    """Properties of a bench that exclude effects; a property is None if it is unknown.

    `own_meters`: each channel has its own voltmeter. `fixed_ranges`: no voltmeter changes its range.
    `scale_on_axis`: the scale of the head is on the axis of the head itself, without a gear.
    """

    own_meters: bool | None = None
    fixed_ranges: bool | None = None
    scale_on_axis: bool | None = None

    @classmethod
    def of(cls, bench: BenchFile) -> KnownBench:
        """Return the properties of the bench in a bench file; voltmeter ranges are always fixed there."""
        meters = bench.instruments.voltmeters
        return cls(
            own_meters=all(len(meter.channels) == 1 for meter in meters),
            fixed_ranges=True,
            scale_on_axis=bench.instruments.head.scale_on_axis,
        )

    def absent(self, readings: Readings) -> dict[str, str]:
        """Return the effects that this bench or these readings cannot have, with reasons.

        Voltmeter ranges recorded in the readings take precedence over `fixed_ranges`.
        """
        fixed, said = self.fixed_ranges, message("the bench file has fixed ranges")
        recorded = _ranges(readings)
        if recorded:
            fixed, said = len(recorded) == 1, message("all readings were taken on one range")
        why = {
            "range_offset": said if fixed else "",
            "channel_crosstalk": message("each channel has a voltmeter of its own")
            if self.own_meters
            else "",
            "meters_exchanged": message("one voltmeter reads all channels")
            if self.own_meters is False
            else "",
            "backlash": message("the head's scale sits on the axis itself") if self.scale_on_axis else "",
            **dict.fromkeys(OF_METER_WARMTH, "" if meter_c(readings.extra) is not None else NO_METER_C),
            **dict.fromkeys(OF_RECORDS, message("searched only in records at a known input")),
        }
        return {name: why[name] for name in CATALOGUE if why.get(name)}

    def not_judged(self, readings: Readings) -> str:
        """Return a sentence on the effects searched only because the bench is unknown; "" if there are none."""
        unknown = {
            "range_offset": self.fixed_ranges is None and not _ranges(readings),
            "channel_crosstalk": self.own_meters is None,
            "meters_exchanged": self.own_meters is None,
            "backlash": self.scale_on_axis is None,
        }
        names = [name for name in CATALOGUE if unknown.get(name)]
        if not names:
            return ""
        return message(
            f"no bench file was named, so the search includes {', '.join(names)}, which not every bench can have; "
            "--bench FILE states its meters and head"
        )


def _ranges(readings: Readings) -> set[str]:
    return {str(text).strip() for text in readings.extra.get("range_v", ())} - {""}


NOTHING_KNOWN = KnownBench()
"""The properties of an unknown bench: no effect is ruled out."""
