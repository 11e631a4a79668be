"""Order files: who asked for what, in which condition each unit came, what was agreed."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from bench.base.form_mistakes import Place
from bench.base.forms import FileModel, load_validated, part
from bench.certificate.laboratory import Contact
from bench.devices.certificates import Day
from bench.files.bench.stand import StatedRule

AS_FOUND, AS_LEFT = "as found", "as left"


class Adjusted(FileModel):
    """What was adjusted or mended, and the run, by name or path, that shows the unit as it was found before."""

    what: str
    as_found: str | None = None


class External(FileModel):
    """Results that another body provided: `what` they are, `by` whom (ISO/IEC 17025:2017, 7.8.2.1 p)."""

    what: str
    by: str


class Supplied(FileModel):
    """Data of the customer that the certificate uses (ISO/IEC 17025:2017, 7.8.2.2).

    `affects_validity` is false only where a wrong value could not make a result wrong.
    """

    what: str
    affects_validity: bool = True


class UnitOrder(FileModel):
    """A unit of an order: when it came, in which condition, and whether the run shows it as found or as left.

    `serial` is left out for units that are all alike in this. `calibrated` is the day of readings
    that were imported from elsewhere: a record says itself when it was measured. `deviations` are from the method.
    """

    serial: str | None = None
    manufacturer: str | None = None
    reference: str | None = None
    received: Day
    condition: str
    calibrated: Day | None = None
    state: Literal["as found", "as left"]
    adjusted: Adjusted | None = None
    deviations: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _left_where_adjusted(self) -> UnitOrder:
        if self.adjusted is not None and self.state == AS_FOUND:
            raise ValueError(
                "a unit that was adjusted is shown 'as left'; name the run before under adjusted"
            )
        return self


class Order(StatedRule):
    """An order file, validated. `place` is where it was calibrated, where that was not the laboratory's.

    `rule` and `guard_band` are the decision rule that was agreed with the customer, before what the record states
    (ISO/IEC 17025:2017, 7.1.3), `agreed` what else was; `without_certificates` why the customer takes results of
    instruments that have none. `sampling` names plan and method where units were chosen out of many, and by whom;
    without it the units are those that the customer gave. `external` are results of other bodies, `supplied` data
    of the customer.
    """

    customer: Contact
    number: str
    date: Day | None = None
    units: Annotated[tuple[UnitOrder, ...], Field(min_length=1)]
    place: str | None = None
    agreed: tuple[str, ...] = ()
    without_certificates: str | None = None
    sampling: str | None = None
    external: tuple[External, ...] = ()
    supplied: tuple[Supplied, ...] = ()

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield units that stand twice, and days that cannot be."""
        units = part(data, "units")
        seen: set[object] = set()
        for place, unit in enumerate(units if isinstance(units, list) else ()):
            serial = part(unit, "serial")
            if serial in seen:
                yield (
                    ("units", place),
                    f"unit {serial or 'without a serial number'} stands twice; leave one out",
                )
            if serial is None or isinstance(serial, str):
                seen.add(serial)

    def unit(self, serial: str) -> UnitOrder | None:
        """Return what is said of a unit: by its serial number, else what is said of all alike."""
        named = next((unit for unit in self.units if unit.serial == serial), None)
        return named or next((unit for unit in self.units if unit.serial is None), None)


def load_order(path: Path) -> Order:
    """Read an order file. Raises `FileMistakes` with every mistake in it."""
    return load_validated(path, Order)
