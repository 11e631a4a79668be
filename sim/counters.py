"""Simulated counters of an encoder on the head, and a simulated thermometer that sends lines of text.

The counters are a Heidenhain ND 281B or ND 287, one with the MUX-10 format, and one that sends lines of text.
Sources: see `drivers.facts`. The encoder has no errors and no noise: it shows the angles of the head's scale.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, Final

from drivers.facts import heidenhain_nd28x as nd
from drivers.facts import mitutoyo_mux10, text_line
from sim.wires.session import LineEnds, PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World


class Counter(PlainDialect):
    """A counter that shows `zero_deg` at 0° of the head's scale.

    The value of a `falling` counter falls while the angle of the head rises. A counter that is not `referenced` was
    just switched on: it counts from zero at the present angle of the head.
    """

    def __init__(
        self, world: World, *, zero_deg: float = 0.0, falling: bool = False, referenced: bool = True
    ) -> None:
        self._world = world
        self._zero_deg = zero_deg
        self._sign = -1.0 if falling else 1.0
        self._lost_deg = 0.0
        self.referenced = True
        self.failed = False
        if not referenced:
            self.power_cycle()

    @property
    def shown_deg(self) -> float:
        """The value of the counter, degrees."""
        return self._zero_deg + self._sign * math.degrees(self._world.scale_angle_rad) - self._lost_deg

    def power_cycle(self) -> None:
        """Switch off and on: the present angle of the head becomes zero."""
        self._lost_deg += self.shown_deg
        self.referenced = self.failed = False

    def cross_reference(self) -> None:
        """Cross the reference mark: from then on, the values are angles of the scale."""
        self._lost_deg, self.referenced, self.failed = 0.0, True, False

    def lose_counts(self, lost_deg: float) -> None:
        """Reduce the value by `lost_deg`, degrees, without any message, as if the counter had missed counts."""
        self._lost_deg += lost_deg

    def fail(self) -> None:
        """Fail the encoder's signal: the counter answers with a message in place of a value."""
        self.failed = True


class HeidenhainNd28x(Counter):
    """A display unit of the `model` ND-281B or ND-287, set to decimal degrees with four decimals.

    `options` are the arguments of `Counter`.
    """

    line_ends = LineEnds((nd.WRITE_TERMINATION.encode(),), reply=b"\r\n", clears=False)

    def __init__(self, world: World, *, model: str = "ND-281B", **options: Any) -> None:
        super().__init__(world, **options)
        self.model = model
        self.status_bar = "00010211"
        self.inch = nd.DARK

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Return STX and the output of a command, or NAK for an unknown command."""
        outputs = {
            nd.ASK_DEVICE: self._device,
            nd.ASK_DISPLAY: self._display,
            nd.ASK_SOFTWARE: self._software,
            nd.ASK_INDICATORS: self._indicators,
        }
        if self.model == "ND-287":
            outputs[nd.ASK_STATUS_BAR] = self.status_bar
        said = outputs.get(message.decode("latin-1"))
        return nd.NAK.encode() if said is None else f"{nd.STX}{said}".encode("ascii")

    @property
    def _software(self) -> str:
        return "646118-01 " if self.model == "ND-287" else "349797-04 "

    @property
    def _device(self) -> str:
        version = "V1-01" if self.model == "ND-287" else "2001-05-04"
        return "\r\n".join(f"{part:<10}" for part in (self.model, self._software, version))

    @property
    def _display(self) -> str:
        return "SIGNAL ERR. " if self.failed else f"{self.shown_deg:+011.4f}"

    @property
    def _indicators(self) -> str:
        if self.model == "ND-287":
            return f"0000000{nd.GLOWS if self.referenced else nd.BLINKS}0"
        ref = nd.GLOWS if self.referenced else nd.BLINKS
        return f"{ref}10000{self.inch}0000000"


class MitutoyoMux10(Counter):
    """A counter in the MUX-10 format; its encoder is on `channel`, and `options` are arguments of `Counter`."""

    model = mitutoyo_mux10.MODEL
    line_ends = LineEnds((b"\r",), reply=b"\r")

    def __init__(self, world: World, *, channel: int = 1, **options: Any) -> None:
        super().__init__(world, **options)
        self._channel = str(channel)

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Return a reading if the message is the channel's number; None for any other message."""
        if message.strip() != self._channel.encode():
            return None
        return b"911" if self.failed else f"0{self._channel}A{self.shown_deg:+09.4f}".encode("ascii")


_NUMBER: Final = re.compile(r"([+-]?)( *)(\d+)(?:\.(\d+))?")


class _Reply:
    """The reply to `request` in the form of the line `example`, in which `pattern` finds the number."""

    def __init__(self, request: str, pattern: str, example: str, errors: tuple[str, ...], group: str) -> None:
        self._request = request.encode("ascii")
        self._error = next(iter(errors), "?").encode("ascii")
        match = re.fullmatch(pattern, example)
        first, last = match.span(group) if match else (0, len(example))
        self._around = example[:first], example[last:]
        self._example = example[first:last]

    def to(self, message: bytes, value: float, failed: bool) -> bytes | None:
        """Return the line for `value`, or an error line if `failed`; None if `message` is not the request."""
        if message.removesuffix(b"\r") != self._request:
            return None
        begin, end = self._around
        return self._error if failed else f"{begin}{self._number(value)}{end}".encode("ascii", "replace")

    def _number(self, value: float) -> str:
        """Return the number with sign, width and decimals as in the example."""
        match = _NUMBER.fullmatch(self._example)
        decimals = len(match[4] or "") if match else 4
        whole = len(match[3]) if match else 1
        wide = f"{abs(value):.{decimals}f}".zfill(whole + (decimals + 1 if decimals else 0))
        plus = match[1] if match else ""
        return f"{'-' if value < 0.0 else '+' if plus else ''}{wide}"


class EncoderLine(Counter):
    """A counter that answers `request` with a line like `example`, in which `pattern` finds the number.

    `per_turn` units make a turn. Messages end in `ends[0]`, replies in `ends[1]`. If the encoder's signal has
    failed, the reply is the first of the `errors`, or "?" if there is none. `options` are the arguments of
    `Counter`.
    """

    model = text_line.MODEL

    def __init__(
        self,
        world: World,
        *,
        request: str,
        pattern: str,
        example: str,
        per_turn: float,
        ends: tuple[str, str],
        errors: tuple[str, ...] = (),
        **options: Any,
    ) -> None:
        super().__init__(world, **options)
        self.line_ends = LineEnds((ends[0].encode(),), reply=ends[1].encode())
        self._per_deg = per_turn / 360.0
        self._reply = _Reply(request, pattern, example, errors, text_line.ANGLE)

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Return the reply to the request; None for any other message."""
        return self._reply.to(message, self.shown_deg * self._per_deg, self.failed)


class LineThermometer(PlainDialect):
    """A thermometer at the block, with the constant error `error_c`, °C; it answers as `EncoderLine` does."""

    model = text_line.MODEL

    def __init__(
        self,
        world: World,
        *,
        request: str,
        pattern: str,
        example: str,
        ends: tuple[str, str],
        errors: tuple[str, ...] = (),
        error_c: float = 0.0,
    ) -> None:
        self.line_ends = LineEnds((ends[0].encode(),), reply=ends[1].encode())
        self._world = world
        self._error_c = error_c
        self._reply = _Reply(request, pattern, example, errors, text_line.TEMPERATURE)
        self.failed = False

    def power_cycle(self) -> None:
        """Switch off and on, which changes nothing."""

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Return the reply to the request; None for any other message."""
        return self._reply.to(message, self._world.block_c + self._error_c, self.failed)
