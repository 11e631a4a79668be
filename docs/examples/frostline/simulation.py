"""A simulated Frostline 7 chamber."""


class Frostline7:
    def __init__(self, world, *, lowest_c=-40.0, highest_c=85.0):
        self._world, self._range, self._set_c, self._run = world, (lowest_c, highest_c), 23.0, "0"

    def handle(self, message, interrupted):
        word, _, value = message.decode("ascii", "replace").partition(" ")
        if word == "SET" and value:
            self._set_c = min(max(float(value), self._range[0]), self._range[1])
        elif word == "RUN" and value:
            self._run = value
            self._world.ramp_chamber(self._set_c) if value == "1" else self._world.switch_chamber_off()
        air, set_point = f"{self._world.chamber_c:.1f}", f"{self._set_c:.1f}"
        replies = {"ID?": "FROSTLINE 7 1.42", "SET?": set_point, "RUN?": self._run, "AIR?": air}
        return replies[word].encode("ascii") if word in replies else None

    def power_cycle(self):
        self._set_c, self._run = 23.0, "0"
        self._world.switch_chamber_off()

    def device_clear(self): ...
    def input_overflow(self): ...
