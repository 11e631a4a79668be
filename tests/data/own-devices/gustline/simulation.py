"""A simulated Gustline 2 thermometer."""

from sim.wires.session import LineEnds, PlainDialect


class Gustline2(PlainDialect):
    line_ends = LineEnds((b"\r",), reply=b"\r")

    def __init__(self, world):
        self._world = world

    def handle(self, message, interrupted):
        shown = f"T={self._world.block_c:+.2f} C P=1013.2 hPa"
        reply = {b"ID?": "GUSTLINE 2 1.0", b"T?": shown}.get(message)
        return None if reply is None else reply.encode("ascii")

    def power_cycle(self): ...
