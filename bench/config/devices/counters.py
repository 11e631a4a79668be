"""Counters of an encoder on a head that a person turns: Heidenhain ND 28x, MUX-10, a line of text."""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from bench.config.devices.device import (
    Device,
    IdentityPattern,
    Port,
    PortSection,
    is_serial,
    resource_on,
)
from bench.config.devices.sections import HeadTruth, ReadOutHeadForm
from drivers.facts import encoder_line, mitutoyo_mux10
from drivers.facts import heidenhain_nd28x as nd

Wire = Annotated[
    str,
    resource_on("ASRL", "TCPIP", example="'ASRL/dev/ttyUSB0::INSTR' or 'TCPIP0::192.0.2.60::4001::SOCKET'"),
]


class NdPort(PortSection):
    """The serial port of a display unit, with 7 data bits and even parity."""

    known: ClassVar = nd.BAUD_RATES

    @property
    def data_bits(self) -> Literal[7]:
        """Data bits of a character."""
        return 7


class HeidenhainNd28xSection(ReadOutHeadForm):
    """A Heidenhain display unit, ND 281B or ND 287, that shows decimal degrees.

    Its port has 7 data bits, even parity and two stop bits.
    """

    facts: ClassVar = nd

    driver: Literal["heidenhain-nd28x"]
    resource: Wire
    model: Literal["ND-281B", "ND-287"] = "ND-281B"
    serial: NdPort = NdPort.of(nd)

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's option `model`: the display unit that the driver must find."""
        return {"model": self.model}

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the options of every simulated counter, and `model`."""
        return super().simulation_options(truth) | {"model": self.model}


class MitutoyoMux10Section(ReadOutHeadForm):
    """A counter that shows degrees and sends its readings in the form of a Mitutoyo MUX-10."""

    facts: ClassVar = mitutoyo_mux10

    driver: Literal["mitutoyo-mux10"]
    resource: Wire
    channel: Annotated[int, Field(ge=1, le=mitutoyo_mux10.MOST_CHANNELS)] = 1
    serial: PortSection = PortSection.of(mitutoyo_mux10)

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's option: the channel to which the encoder is connected."""
        return {"channel": self.channel}

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the options of every simulated counter, and the channel to which the encoder is connected."""
        return super().simulation_options(truth) | {"channel": self.channel}


End = Literal["CR", "LF", "CR LF"]


def _plain(text: str) -> str:
    if re.fullmatch(r"[\x20-\x7e]+", text) is None:
        raise ValueError("expected printable ASCII characters; line ends are stated by 'ends'")
    return text


Printable = Annotated[str, AfterValidator(_plain)]


class EncoderLineSection(ReadOutHeadForm):
    """A counter that answers `request` with one line of text.

    The whole line must match `pattern`, a regular expression; its group `angle`, as in `(?P<angle>...)`, is the
    number in the `unit`. `counts_per_turn` is required if the unit is counts, and else refused. `example` is a line
    as the counter sends it. `errors` maps each line that the counter sends instead of an angle to its meaning.
    `model` names the counter in the record.
    """

    facts: ClassVar = encoder_line

    driver: Literal["encoder-line"]
    resource: Wire
    model: Printable = "encoder"
    request: Printable
    request_end: End = "CR LF"
    reply_end: End = "CR LF"
    pattern: IdentityPattern
    example: Printable
    unit: Literal["degrees", "arcsec", "counts"] = "degrees"
    counts_per_turn: Annotated[float, Field(gt=0.0)] | None = None
    errors: Annotated[dict[Printable, str], Field(default_factory=dict)]
    serial: PortSection = PortSection.of(encoder_line)

    @field_validator("pattern")
    @classmethod
    def _has_an_angle(cls, pattern: str) -> str:
        if list(re.compile(pattern).groupindex) != [encoder_line.ANGLE]:
            raise ValueError(
                rf"expected one named group, such as in 'POS=(?P<angle>[+-]\d+\.\d+)', got '{pattern}'"
            )
        return pattern

    @model_validator(mode="after")
    def _fits(self) -> EncoderLineSection:
        match = re.fullmatch(self.pattern, self.example)
        if match is None:
            raise ValueError(
                f"the pattern '{self.pattern}' does not match the example; correct one of "
                f"them: '{self.example}'"
            )
        if re.fullmatch(r"[+-]? *\d+(?:\.\d+)?", match[encoder_line.ANGLE] or "") is None:
            raise ValueError(
                "correct the pattern: the angle in the example is not a number, but "
                f"'{match[encoder_line.ANGLE]}'"
            )
        for error in self.errors:
            if re.fullmatch(self.pattern, error) is not None:
                raise ValueError(
                    f"the pattern matches the error '{error}': exclude it, or it is read as an angle"
                )
        if (self.unit == "counts") != (self.counts_per_turn is not None):
            raise ValueError("state 'counts_per_turn' if, and only if, the unit is counts")
        return self

    @property
    def per_turn(self) -> float:
        """The number of units in a turn."""
        return self.counts_per_turn or encoder_line.PER_TURN[self.unit]

    def port(self) -> Port:
        """Return the setup of its wire, with the line ends of the section."""
        ends = encoder_line.ENDS
        serial = {**encoder_line.SERIAL, **self.serial.settings()} if is_serial(self.resource) else None
        return Port(ends[self.reply_end], ends[self.request_end], serial)

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's options: `model`, `request`, `pattern`, `errors` and `per_turn`."""
        own = self.model_dump(include={"model", "request", "pattern", "errors"})
        return own | {"per_turn": self.per_turn}

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the options of every simulated counter, the request, and the form of the reply with an example."""
        ends = encoder_line.ENDS
        return {
            **super().simulation_options(truth),
            **self.model_dump(include={"request", "pattern", "example"}),
            "per_turn": self.per_turn,
            "ends": (ends[self.request_end], ends[self.reply_end]),
            "errors": tuple(self.errors),
        }


_OWN: Final = {"tolerance": "30 arcsec"}

DEVICE = (
    Device(
        "heidenhain-nd28x",
        HeidenhainNd28xSection,
        driver="drivers.instruments.heidenhain_nd28x:HeidenhainNd28x",
        simulation="sim.counters:HeidenhainNd28x",
        example={"resource": "ASRL/dev/ttyUSB0::INSTR", "model": "ND-287", **_OWN},
        simulated=("homed",),
        place=3,
    ),
    Device(
        "mitutoyo-mux10",
        MitutoyoMux10Section,
        driver="drivers.instruments.mitutoyo_mux10:MitutoyoMux10",
        simulation="sim.counters:MitutoyoMux10",
        example={"resource": "ASRL/dev/ttyUSB0::INSTR", **_OWN},
        simulated=("homed",),
        place=4,
    ),
    Device(
        "encoder-line",
        EncoderLineSection,
        driver="drivers.instruments.encoder_line:EncoderLine",
        simulation="sim.counters:EncoderLine",
        example={
            "resource": "ASRL/dev/ttyUSB0::INSTR",
            "request": "POS?",
            "pattern": r"POS=(?P<angle>[+-]\d{3}\.\d{5})",
            "example": "POS=+045.00278",
            "errors": {"ERR SIGNAL": "the encoder's signal is too small"},
            **_OWN,
        },
        simulated=("homed",),
        place=5,
    ),
)
