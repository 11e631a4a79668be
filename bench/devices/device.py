"""What an instrument states of itself to be one: name and section in bench files, driver, simulation."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from bench.base.forms import FileModel

Role = Literal["voltmeter", "head", "chamber", "level", "thermometer", "power_supply"]


class DeviceSection(FileModel):
    """The section of an instrument in a bench file; the form of its role stands between this and it."""

    role: ClassVar[Role]
    by_hand: ClassVar[bool] = False
    """Whether a person works the instrument: it has no wire, and nothing stands for it in a simulation."""

    driver: str

    @classmethod
    def alternatives(cls) -> Iterable[type[FileModel]]:
        """Return the sections of all instruments, for the form of a role."""
        if "role" not in cls.__dict__:
            return ()
        from bench.devices.registry import devices

        return [device.section for device in devices().of(cls.role)]

    def driver_options(self) -> dict[str, Any]:
        """Return what its driver is given by keyword, beside what all of its role are given."""
        return {}

    def simulation_options(self, truth: Any) -> dict[str, Any]:
        """Return what its simulation is given by keyword; `truth` is what the bench file says of its role's."""
        return {}


@dataclass(frozen=True)
class Device:
    """An instrument, declared: a module of this folder, or of a plug-in, has it as `DEVICE`.

    `name` is what `driver` says in a bench file. `driver` and `simulation` name classes, "module:Class", a module
    with a leading dot beside the declaration's own; one that a person works has no simulation. `example` is a
    section as a bench file has it (of a voltmeter with one signal, that of x). `simulated` are the keys of the
    bench file's section on its role in a simulation that its simulation heeds. `place` is where it stands among
    those of its role when they are listed; those without one come after, by name.
    """

    name: str
    section: type[DeviceSection]
    driver: str
    simulation: str | None
    example: Mapping[str, Any]
    simulated: tuple[str, ...] = ()
    place: int = 100
    package: str = ""
    """The package beside which modules with a leading dot are looked for; the registry sets it."""

    @property
    def role(self) -> Role:
        """What kind of instrument it is."""
        return self.section.role

    def class_of(self, which: Literal["driver", "simulation"]) -> Any:
        """Import the driver or the simulation and return its class. Raises what the import raises."""
        module, _, attribute = str(getattr(self, which)).partition(":")
        return getattr(importlib.import_module(module, self.package or None), attribute)
