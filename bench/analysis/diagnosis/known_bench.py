"""What a bench has and has not: an effect of something that is not there is no candidate."""

from __future__ import annotations

from dataclasses import dataclass

from bench.files.bench.file import BenchFile
from bench.model import CATALOGUE
from bench.readings.table import Readings


@dataclass(frozen=True)
class KnownBench:
    """What decides which effects can be there; None where nobody says it.

    `own_meters`: each channel has a meter of its own. `fixed_ranges`: no meter changes its range.
    `scale_on_axis`: the head's scale sits on the axis that turns the block, and no gear is between them.
    """

    own_meters: bool | None = None
    fixed_ranges: bool | None = None
    scale_on_axis: bool | None = None

    @classmethod
    def of(cls, bench: BenchFile) -> KnownBench:
        """Return what a bench file says: in it the ranges of voltmeters are fixed."""
        meters = bench.instruments.voltmeters
        return cls(
            own_meters=all(len(meter.channels) == 1 for meter in meters),
            fixed_ranges=True,
            scale_on_axis=bench.instruments.head.scale_on_axis,
        )

    def absent(self, readings: Readings) -> dict[str, str]:
        """Return the effects of the catalogue that cannot be there, each with the reason.

        What the record says of its ranges counts for more than what the bench file says.
        """
        fixed, said = self.fixed_ranges, "the bench file has fixed ranges"
        recorded = {str(text).strip() for text in readings.extra.get("range_v", ())} - {""}
        if recorded:
            fixed, said = len(recorded) == 1, "all readings were taken on one range"
        why = {
            "range_offset": said if fixed else "",
            "channel_crosstalk": "each channel has a voltmeter of its own" if self.own_meters else "",
            "meters_exchanged": "one voltmeter reads all channels" if self.own_meters is False else "",
            "backlash": "the head's scale sits on the axis itself" if self.scale_on_axis else "",
        }
        return {name: why[name] for name in CATALOGUE if why.get(name)}

    def not_judged(self, readings: Readings) -> str:
        """Return which effects are looked for as nobody says that the bench cannot have them; or nothing."""
        recorded = {str(text).strip() for text in readings.extra.get("range_v", ())} - {""}
        unknown = {
            "range_offset": self.fixed_ranges is None and not recorded,
            "channel_crosstalk": self.own_meters is None,
            "meters_exchanged": self.own_meters is None,
            "backlash": self.scale_on_axis is None,
        }
        names = [name for name in CATALOGUE if unknown.get(name)]
        if not names:
            return ""
        return (
            f"whether the bench can have {', '.join(names)} was not judged, as nobody named its bench file: "
            "they are looked for; --bench FILE says what meters and head it has"
        )


NOTHING_KNOWN = KnownBench()
"""Of a bench of which nobody says anything."""
