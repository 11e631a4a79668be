"""The instruments of a bench file, all together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from bench.base.arrays import CHANNELS
from bench.base.forms import FileModel
from bench.devices.chambers import ChamberForm
from bench.devices.heads import HeadForm
from bench.devices.levels import LevelForm
from bench.devices.registry import chosen_by_driver
from bench.devices.supplies import SupplyForm
from bench.devices.thermometers import ThermometerForm
from bench.devices.voltmeters import VoltmeterForm
from bench.devices.wires import WiredForm

InstrumentForm = VoltmeterForm | HeadForm | ChamberForm | LevelForm | ThermometerForm | SupplyForm


class InstrumentsSection(FileModel):
    """Everything that is opened for a run; the driver chooses what else a section says."""

    voltmeters: Annotated[
        tuple[Annotated[VoltmeterForm, chosen_by_driver("voltmeter")], ...],
        Field(min_length=1, max_length=len(CHANNELS)),
    ]
    head: Annotated[HeadForm, chosen_by_driver("head")]
    chamber: Annotated[ChamberForm | None, chosen_by_driver("chamber")] = None
    level: Annotated[LevelForm | None, chosen_by_driver("level")] = None
    thermometer: Annotated[ThermometerForm | None, chosen_by_driver("thermometer")] = None
    power_supply: Annotated[SupplyForm | None, chosen_by_driver("power_supply")] = None

    def all(self) -> Iterator[InstrumentForm]:
        """Yield the section of every instrument: voltmeters, head, and what else there is."""
        yield from self.voltmeters
        yield self.head
        for further in (self.chamber, self.level, self.thermometer, self.power_supply):
            if further is not None:
                yield further

    @property
    def meter_of_thermometer(self) -> VoltmeterForm | None:
        """The voltmeter of which the thermometer is one channel more; None where it has its own wire, or none."""
        resource = getattr(self.thermometer, "resource", None)
        return next((meter for meter in self.voltmeters if resource and meter.resource == resource), None)

    @property
    def adapters(self) -> dict[str, str]:
        """The GPIB adapters, by the address of each its name on the bench: "adapter", "adapter.2" …."""
        places = [section.place for section in self.all() if isinstance(section, WiredForm)]
        known = dict.fromkeys(place.adapter for place in places if place is not None)
        return {
            address: "adapter" if number == 1 else f"adapter.{number}"
            for number, address in enumerate(known, start=1)
        }

    def names(self) -> Iterator[str]:
        """Yield the name of every instrument, then of every adapter."""
        yield from (section.name for section in self.all())
        yield from self.adapters.values()


class RecordedInstruments(InstrumentsSection):
    """The instruments of a run that is evaluated: of those that nobody here knows what is written is kept."""

    voltmeters: Annotated[
        tuple[Annotated[VoltmeterForm, chosen_by_driver("voltmeter", recorded=True)], ...],
        Field(min_length=1, max_length=len(CHANNELS)),
    ]
    head: Annotated[HeadForm, chosen_by_driver("head", recorded=True)]
    chamber: Annotated[ChamberForm | None, chosen_by_driver("chamber", recorded=True)] = None
    level: Annotated[LevelForm | None, chosen_by_driver("level", recorded=True)] = None
    thermometer: Annotated[ThermometerForm | None, chosen_by_driver("thermometer", recorded=True)] = None
    power_supply: Annotated[SupplyForm | None, chosen_by_driver("power_supply", recorded=True)] = None
