"""Instruments that answer with a line of text, whose form the bench file states; a thermometer among them."""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, model_validator

from bench.config.devices.device import (
    Device,
    IdentityPattern,
    Port,
    PortSection,
    WiredForm,
    any_resource,
    is_serial,
)
from bench.config.devices.sections import SizeK, TemperatureRange, ThermometerForm, ThermometerTruth
from drivers.facts import text_line

End = Literal["CR", "LF", "CR LF"]


def _plain(text: str) -> str:
    if re.fullmatch(r"[\x20-\x7e]+", text) is None:
        raise ValueError("expected printable ASCII characters; line ends are stated by 'ends'")
    return text


Printable = Annotated[str, AfterValidator(_plain)]


class LineForm(WiredForm):
    """The request and the form of the reply of an instrument that answers with one line of text.

    The whole line must match `pattern`, a regular expression; its group, as in `(?P<angle>...)`, is the number.
    `example` is a line as the instrument sends it. `errors` maps each line that it sends instead of a number to its
    meaning. `model` names the instrument in the record.
    """

    group: ClassVar[str]

    model: Printable
    request: Printable
    request_end: End = "CR LF"
    reply_end: End = "CR LF"
    pattern: IdentityPattern
    example: Printable
    errors: Annotated[dict[Printable, str], Field(default_factory=dict)]
    serial: PortSection = PortSection.of(text_line)

    @model_validator(mode="after")
    def _fits(self) -> LineForm:
        if list(re.compile(self.pattern).groupindex) != [self.group]:
            such = rf"POS=(?P<{self.group}>[+-]\d+\.\d+)"
            raise ValueError(
                f"expected one named group in the pattern, such as in '{such}', got '{self.pattern}'"
            )
        match = re.fullmatch(self.pattern, self.example)
        if match is None:
            raise ValueError(
                f"the pattern '{self.pattern}' does not match the example; correct one of "
                f"them: '{self.example}'"
            )
        if re.fullmatch(r"[+-]? *\d+(?:\.\d+)?", match[self.group] or "") is None:
            raise ValueError(
                f"correct the pattern: the {self.group} in the example is not a number, but '{match[self.group]}'"
            )
        for error in self.errors:
            if re.fullmatch(self.pattern, error) is not None:
                raise ValueError(
                    f"the pattern matches the error '{error}': exclude it, or it is read as a number"
                )
        return self

    def port(self) -> Port:
        """Return the setup of its wire, with the line ends of the section."""
        ends = text_line.ENDS
        serial = {**text_line.SERIAL, **self.serial.settings()} if is_serial(self.resource) else None
        return Port(ends[self.reply_end], ends[self.request_end], serial)

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's options: `model`, `request`, `pattern` and `errors`."""
        return self.model_dump(include={"model", "request", "pattern", "errors"})

    def line_options(self) -> dict[str, Any]:
        """Return the simulation's options on the request, and on the form of the reply with an example."""
        ends = text_line.ENDS
        return {
            **self.model_dump(include={"request", "pattern", "example"}),
            "ends": (ends[self.request_end], ends[self.reply_end]),
            "errors": tuple(self.errors),
        }


class LineThermometerSection(TemperatureRange, ThermometerForm, LineForm):
    """A thermometer that answers `request` with one line of text, which holds the temperature in °C.

    A value below `minimum` or above `maximum` is refused; `tolerance` is its error limit.
    """

    facts: ClassVar = text_line
    group: ClassVar = text_line.TEMPERATURE

    driver: Literal["line-thermometer"]
    resource: Annotated[str, AfterValidator(any_resource)]
    model: Printable = "thermometer"
    tolerance: SizeK = 0.5

    @property
    def tolerance_k(self) -> float:
        """The stated tolerance, K."""
        return self.tolerance

    def driver_options(self) -> dict[str, Any]:
        """Return the options of every line of text, and the temperature range, °C."""
        return super().driver_options() | {"minimum_c": self.minimum, "maximum_c": self.maximum}

    def simulation_options(self, truth: ThermometerTruth) -> dict[str, Any]:
        """Return the options of every simulated line of text, and the error of the thermometer, K."""
        return self.line_options() | {"error_c": truth.error}


DEVICE = Device(
    "line-thermometer",
    LineThermometerSection,
    driver="drivers.instruments.line_thermometer:LineThermometer",
    simulation="sim.counters:LineThermometer",
    example={
        "resource": "ASRL/dev/ttyUSB1::INSTR",
        "request": "TEMP?",
        "pattern": r"T=(?P<temperature>[+-]\d+\.\d+) C",
        "example": "T=+23.00 C",
        "errors": {"T=OPEN": "the sensor came off"},
        "minimum": "-40 degC",
        "maximum": "125 degC",
    },
    simulated=("error",),
    place=2,
)
