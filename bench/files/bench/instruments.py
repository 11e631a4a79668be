"""The instruments of a bench file, all together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from bench.base.forms import FileModel
from bench.devices.chambers import ChamberSection
from bench.devices.heads import HeadSection
from bench.devices.voltmeters import VoltmeterSection


class InstrumentsSection(FileModel):
    """Everything that is opened for a run."""

    voltmeters: Annotated[tuple[VoltmeterSection, ...], Field(min_length=1)]
    head: HeadSection
    chamber: ChamberSection | None = None

    @property
    def adapters(self) -> dict[str, str]:
        """The GPIB adapters, by the address of each its name on the bench: "adapter", "adapter.2" …."""
        places = [meter.place for meter in self.voltmeters]
        known = dict.fromkeys(place.adapter for place in places if place is not None)
        return {
            address: "adapter" if number == 1 else f"adapter.{number}"
            for number, address in enumerate(known, start=1)
        }

    def names(self) -> Iterator[str]:
        """Yield the name of every instrument, then of every adapter."""
        yield from (meter.name for meter in self.voltmeters)
        yield self.head.name
        if self.chamber is not None:
            yield self.chamber.name
        yield from self.adapters.values()
