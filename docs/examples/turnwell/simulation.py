"""A simulated Turnwell 3 head."""

import math

from sim.wires.session import PlainDialect


class Turnwell3(PlainDialect):
    def __init__(self, world, *, speed_deg_s):
        self._world, self._speed_rad_s, self._on = world, math.radians(speed_deg_s), False

    def handle(self, message, interrupted):
        word, _, value = message.decode("ascii", "replace").partition(" ")
        if word in ("ON", "OFF"):
            self._on = word == "ON"
        if word in ("OFF", "STOP"):
            self._world.stop_head()
        if word == "GO" and self._on:
            self._world.move_head(math.radians(float(value)), self._speed_rad_s)
        position = f"{math.degrees(self._world.scale_angle_rad):.4f}"
        busy = "1" if self._world.head_rate_rad_s else "0"
        asked = {"ID?": "TURNWELL 3 2.0", "POS?": position, "BUSY?": busy}
        done = {"ON": "OK", "OFF": "OK", "STOP": "OK", "GO": "OK" if self._on else "MOTOR OFF"}
        reply = (asked | done).get(word)
        return None if reply is None else reply.encode("ascii")

    def power_cycle(self):
        self._on = False
        self._world.stop_head()
