"""The known instruments: from this folder, from installed distributions, from folders of the user.

A distribution declares the entry-point group `triaxial_bench.devices`; each entry is a `Device` or a module
with a `DEVICE`. Folders are listed in the environment variable `BENCH_DEVICES` (joined by the system's path
separator) or given with `--devices`. A bench file cannot name folders, because their code is executed. Each
module or package directly in a folder may define a `DEVICE`; modules of a folder import each other relatively
(`from .facts import …`).
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Annotated, Any, Final, Literal, Union, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationInfo,
    create_model,
)

from bench.base.units import SizeRad
from bench.config.devices import FOLDERS
from bench.config.devices.device import WIRE_FACTS, Device, DeviceSection, Role, WiredForm
from bench.config.devices.sections import (
    SUPPLY_FACTS,
    VOLTMETER_FACTS,
    ChamberForm,
    ControlledChamberForm,
    HeadForm,
    LevelForm,
    MotorisedHeadForm,
    ReadOutHeadForm,
    SizeK,
    SupplyForm,
    ThermometerForm,
    VoltmeterForm,
    VoltmeterKind,
    WiredSupplyForm,
)
from drivers.interfaces import BenchError, Channel, SupplyLimits

GROUP: Final = "triaxial_bench.devices"

_HERE: Final = __name__.rpartition(".")[0]


@dataclass
class Devices:
    """The devices found, by name, with the place of each declaration and the problems met in loading."""

    found: dict[str, Device] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)
    doubled: dict[str, str] = field(default_factory=dict)
    """For each name that two devices share, a sentence on both; neither of the two is used."""
    troubles: list[str] = field(default_factory=list)
    """One sentence for each module that could not be loaded."""

    def get(self, name: object) -> Device | None:
        """Return the device with this name; None if there is no such device."""
        return self.found.get(name) if isinstance(name, str) else None

    def of(self, role: Role) -> list[Device]:
        """Return the devices of a role in listing order."""
        return self._by_role[role]

    def adapter(self, role: Role) -> TypeAdapter[DeviceSection]:
        """Return the validator for sections of this role; the key `driver` selects the section class."""
        return self._adapters[role]

    def origin(self, name: str) -> str | None:
        """Return the file or distribution that a device came from; None for a built-in device."""
        place = self.places.get(name, "")
        return None if place.startswith(str(Path(__file__).parent) + os.sep) else place

    def why_not(self, name: object) -> str | None:
        """Return a sentence on why `name` is no usable device; None if it is one, or if no reason is known."""
        if not isinstance(name, str) or name in self.found:
            return None
        if name in self.doubled:
            return self.doubled[name]
        return f"no driver '{name}' is known, and {'; '.join(self.troubles)}" if self.troubles else None

    @cached_property
    def _by_role(self) -> dict[Role, list[Device]]:
        listed = sorted(self.found.values(), key=lambda device: (device.place, device.name))
        return {role: [d for d in listed if d.role == role] for role in get_args(Role)}

    @cached_property
    def _adapters(self) -> dict[Role, TypeAdapter[DeviceSection]]:
        return {
            role: TypeAdapter(_union(tuple(device.section for device in known)))
            for role, known in self._by_role.items()
        }

    def add(self, device: Device, place: str) -> None:
        """Add a device declared in the file or distribution `place`; two devices of one name are both unusable."""
        wrong = _wrong_declaration(device)
        if wrong:
            self.troubles.append(f"{place} cannot be used: {wrong}")
        elif device.name in self.places:
            first = self.places[device.name]
            self.doubled[device.name] = (
                f"the driver '{device.name}' is in {first} and in {place}; remove one of them"
            )
            self.found.pop(device.name, None)
        else:
            self.found[device.name], self.places[device.name] = device, place


def devices() -> Devices:
    """Return the available instruments, including those in the folders that the environment lists now."""
    return _loaded(tuple(folder for folder in os.environ.get(FOLDERS, "").split(os.pathsep) if folder))


def _sections_of(role: Role) -> list[type[DeviceSection]]:
    return [device.section for device in devices().of(role)]


DeviceSection.sections_of = staticmethod(_sections_of)


@lru_cache(maxsize=8)
def _loaded(folders: tuple[str, ...]) -> Devices:
    result = Devices()
    for module in pkgutil.iter_modules(importlib.import_module(_HERE).__path__):
        _take(result, f"{_HERE}.{module.name}", str(Path(__file__).parent / module.name))
    for entry in importlib.metadata.entry_points(group=GROUP):
        _take_entry(result, entry)
    for folder in folders:
        for name, place in _modules_of(result, Path(folder).expanduser().absolute()):
            _take(result, name, place)
    return result


def _modules_of(result: Devices, folder: Path) -> Iterator[tuple[str, str]]:
    """Make the folder a package with a unique name; yield name and path of each module directly in it."""
    if not folder.is_dir():
        result.troubles.append(f"there is no folder of devices {folder}")
        return
    package = f"_devices_{sha256(str(folder).encode()).hexdigest()[:12]}"
    if package not in sys.modules:
        made = ModuleType(package)
        made.__path__ = [str(folder)]
        sys.modules[package] = made
        importlib.invalidate_caches()
    for module in sorted(pkgutil.iter_modules([str(folder)]), key=lambda module: module.name):
        yield f"{package}.{module.name}", str(folder / module.name)


def _take(result: Devices, name: str, place: str) -> None:
    """Import a module and add the devices that it declares, if any; note a failed import."""
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:
        place = f"{place}.py" if Path(f"{place}.py").is_file() else place
        result.troubles.append(f"{place} cannot be loaded ({why_not_loaded(error, Path(place))})")
        return
    _take_from(result, module, str(module.__file__))


def why_not_loaded(error: BaseException, where: Path) -> str:
    """Return kind and words of an error on one line; with the last line of a file in the folder or file `where`."""
    frames = [one for one in extract_tb(error.__traceback__) if Path(one.filename).is_relative_to(where)]
    at = f", {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    words = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {words}{at}"


def _take_from(result: Devices, module: ModuleType, place: str) -> None:
    device = getattr(module, "DEVICE", ())
    for one in device if isinstance(device, tuple) else (device,):
        if isinstance(one, Device):
            result.add(replace(one, package=module.__package__ or ""), place)
        else:
            result.troubles.append(
                f"{place} cannot be used: its DEVICE is no bench.config.devices.device.Device"
            )


def _take_entry(result: Devices, entry: importlib.metadata.EntryPoint) -> None:
    dist = entry.dist
    place = f"the distribution {dist.name} {dist.version}" if dist else f"the entry point {entry.name}"
    try:
        loaded = entry.load()
    except (Exception, SystemExit) as error:
        result.troubles.append(f"{place} cannot be loaded ({type(error).__name__}: {error})")
        return
    if isinstance(loaded, Device):
        result.add(replace(loaded, package=loaded.package or entry.module.rpartition(".")[0]), place)
    else:
        _take_from(result, loaded, place)


_WIRED_FORMS: Final = (
    VoltmeterForm,
    MotorisedHeadForm,
    ReadOutHeadForm,
    ControlledChamberForm,
    LevelForm,
    ThermometerForm,
    WiredSupplyForm,
)
"""The forms of instruments with a wire: each decides with which arguments the driver is constructed."""

_DEFINED_BY_EACH: Final = (
    (VoltmeterForm, "inputs_used"),
    (ThermometerForm, "tolerance_k"),
    (SupplyForm, "limits"),
)
"""Properties that the sections of a role define themselves."""


def _wrong_declaration(device: Device) -> str | None:
    section = device.section
    if (
        not isinstance(section, type)
        or not issubclass(section, DeviceSection)
        or not hasattr(section, "role")
    ):
        return f"the section of '{device.name}' has no known role"
    stated = get_args(section.model_fields["driver"].annotation)
    if stated != (device.name,):
        return f"the section of '{device.name}' does not have driver: Literal['{device.name}']"
    for form, member in _DEFINED_BY_EACH:
        if issubclass(section, form) and getattr(section, member) is getattr(form, member):
            return f"the section of '{device.name}' does not define {member}"
    if issubclass(section, WiredForm):
        if not issubclass(section, _WIRED_FORMS):
            forms = " or ".join(form.__name__ for form in _WIRED_FORMS if form.role == device.role)
            return f"the section of '{device.name}' has a wire, but does not subclass {forms}"
        of_voltmeter = VOLTMETER_FACTS if issubclass(section, VoltmeterForm) else ()
        of_supply = SUPPLY_FACTS if issubclass(section, SupplyForm) else ()
        needed = (*WIRE_FACTS, *of_voltmeter, *of_supply)
        lacking = [name for name in needed if not hasattr(getattr(section, "facts", None), name)]
        if lacking:
            return f"the facts of '{device.name}' lack {', '.join(lacking)}"
    return None


def _union(sections: tuple[type[DeviceSection], ...]) -> Any:
    return Annotated[Union[sections], Field(discriminator="driver")]  # noqa: UP007 - of as many as there are


RECORDED: Final = "recorded"
"""The validation context for a bench file that was recorded with a run."""


def chosen_by_driver(role: Role, *, name: str = "") -> BeforeValidator:
    """Return a validator that turns a section as written into the section class of its `driver`.

    `name` is the default name of the instrument; if it is empty, the section class has a default.

    An unknown driver gives one error only, which lists similar names or says why the driver could not be loaded. In
    the context `RECORDED`, the section of an unknown driver is kept as written.
    """

    def choose(written: object, info: ValidationInfo) -> object:
        if not isinstance(written, dict):
            return written
        return _validated({"name": name, **written} if name else written, role, info.context == RECORDED)

    return BeforeValidator(choose)


def unknown_drivers(sections: Iterable[object]) -> list[str]:
    """Return the names of unknown drivers, sorted, in `sections` as they are written in the file."""
    stated = [section.get("driver") for section in sections if isinstance(section, dict)]
    return sorted({name for name in stated if isinstance(name, str) and devices().get(name) is None})


def _validated(written: dict[str, Any], role: Role, recorded: bool) -> DeviceSection:
    known = devices()
    driver = written.get("driver")
    if recorded and unknown_drivers([written]):
        return OF_ROLE[role].model_validate(written)
    if known.get(driver) not in known.of(role):
        names = tuple(device.name for device in known.of(role))
        _refuse_driver(written, known.why_not(driver) or _strange(driver, names), names)
    return known.adapter(role).validate_python(written)


def _strange(driver: object, names: tuple[str, ...]) -> str | None:
    """Return the message for a driver name that resembles none of `names`; None for a similar name or no string."""
    if not isinstance(driver, str) or difflib.get_close_matches(driver, names, n=1, cutoff=0.5):
        return None
    return (
        f"expected {', '.join(names[:-1])} or {names[-1]}, got '{driver}'; for an instrument of your own, "
        "name its folder with --devices DIR or BENCH_DEVICES"
    )


def _refuse_driver(written: dict[str, Any], reason: str | None, names: tuple[str, ...]) -> None:
    """Raise `ValidationError` for a missing or unknown driver of a section; `reason` replaces the default text."""

    def refuse(_: str) -> str:
        raise ValueError(reason)

    kind: Any = Literal[names] if reason is None else Annotated[str, AfterValidator(refuse)]
    fields: dict[str, Any] = {"driver": (kind, ...)}
    create_model("Named", __config__=ConfigDict(extra="ignore"), **fields).model_validate(written)


KEPT: Final = ConfigDict(extra="allow")


class UnknownVoltmeter(VoltmeterForm):
    """A voltmeter with an unknown driver; only its signals and its range are known."""

    model_config = KEPT

    resource: str = ""
    stated_channels: tuple[Channel, ...] = Field((), alias="channels")
    inputs: Any = None

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The signals, in the order of their channel numbers if the section states `inputs`, else as stated."""
        if isinstance(self.inputs, dict):
            return tuple(sorted(self.inputs, key=lambda signal: _number(self.inputs[signal])))
        return self.stated_channels

    @property
    def kind(self) -> VoltmeterKind:
        """Raise `BenchError`: without the driver, limits and accuracy are unknown."""
        raise BenchError(
            self.name,
            f"the driver '{self.driver}' is missing, so the accuracy of its voltmeters is unknown",
            "name the driver's folder with --devices or BENCH_DEVICES, or install it",
        )


class UnknownHead(HeadForm):
    """A head with an unknown driver."""

    model_config = KEPT

    tolerance: SizeRad = 0.0


class UnknownChamber(ChamberForm):
    """A chamber with an unknown driver; its temperature range is known, and its band if the file states one."""

    model_config = KEPT

    band: SizeK | None = None


class UnknownLevel(LevelForm):
    """A level with an unknown driver."""

    model_config = KEPT


class UnknownThermometer(ThermometerForm):
    """A thermometer with an unknown driver; its certificate is known if stated."""

    model_config = KEPT

    @property
    def tolerance_k(self) -> float:
        """The assumed limit of the thermometer's error, K: that of an ordinary thermometer."""
        return 0.5


class UnknownSupply(SupplyForm):
    """A power supply with an unknown driver."""

    model_config = KEPT

    @property
    def limits(self) -> SupplyLimits | None:
        """None: without the driver, the limits are unknown."""
        return None


OF_ROLE: Final[dict[Role, type[DeviceSection]]] = {
    "voltmeter": UnknownVoltmeter,
    "head": UnknownHead,
    "chamber": UnknownChamber,
    "level": UnknownLevel,
    "thermometer": UnknownThermometer,
    "power_supply": UnknownSupply,
}


def _number(text: object) -> float:
    try:
        return float(str(text))
    except ValueError:
        return 0.0
