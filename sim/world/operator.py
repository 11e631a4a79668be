"""The operator of a simulated bench, and the supply's front panel that the operator works."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from bench.base.arrays import ARCSEC
from drivers.interfaces import NoAnswer
from drivers.person import Answer, Prompt, PromptKind
from sim.world.chance import keyed_generator

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from drivers.interfaces import Direction
    from drivers.person import ReadSupply, SetSupply, SwitchSupply, TurnHead
    from sim.world.world import World


def work_supply(world: World, action: SetSupply | SwitchSupply | ReadSupply) -> str:
    """Carry out an action at the supply; return the displayed value for a `ReadSupply`, else an empty text."""
    power, now_s = world.power, world.clock.now_s()
    if action["do"] == "set_supply":
        for output, (voltage_v, limit_a, over_voltage_v) in action["outputs"].items():
            power.change(output, now_s, set_v=voltage_v, limit_a=limit_a, trip_v=over_voltage_v)
        return ""
    output = action["output"]
    if action["do"] == "switch_supply":
        power.change(output, now_s, on=action["on"], tripped=None)
        return ""
    stage, shown = power.stage(output, now_s), power.shown(output, now_s)
    return {
        "switch": "on" if stage.on else "off",
        "set_voltage": f"{stage.set_v:.3f}",
        "current_limit": f"{stage.limit_a:.4f}",
        "voltage": f"{shown.voltage_v:.2f}",
        "current": f"{shown.current_a:.3f}",
    }[action["what"]]


LOOK_S: Final = 10.0
"""Interval between calls of `meanwhile` during any other task, s."""
REST_LOOK_S: Final = 0.5
LONGEST_WAIT_S: Final = 60.0
"""Interval between calls of `meanwhile` while the person waits for an encoder, and longest such wait, s."""
_SLIPS_ARCSEC: Final = (3600.0, -3600.0, 600.0, -600.0, 60.0, -60.0)
_TAKES: Final = {
    "mount": "mount_time_s",
    "level_platform": "mount_time_s",
    "read_head": "second_look_s",
    **dict.fromkeys(("set_supply", "switch_supply", "read_supply"), "display_time_s"),
    **dict.fromkeys(
        ("set_temperature", "read_temperature", "select_input", "place_level", "read_level"), "task_time_s"
    ),
}
"""The tasks that take one of the times in `OperatorSettings`."""


@dataclass(frozen=True)
class OperatorSettings:
    """Settings of the simulated operator: accuracy, times and slips.

    The operator sets the head with a normal error of standard deviation `setting_deviation_rad`, to a whole
    step `resolution_rad` of the scale. Times are in s. A turn takes a time drawn uniformly from the interval
    `turn_time_s`. Mounting the block or levelling the platform takes `mount_time_s`, a second look at the
    scale `second_look_s`, an action at the supply `display_time_s`. An action at chamber, thermometer, level
    or input switch takes `task_time_s`; other tasks take no time.
    With `slip_probability` a slip occurs: the typed angle is off by 1°, 10′ or 1′ although the head is set
    correctly. If an encoder reads the head and no angle is typed, a slip is an approach from the wrong side.
    """

    setting_deviation_rad: float = 2.0 * ARCSEC
    resolution_rad: float = ARCSEC
    turn_time_s: tuple[float, float] = (60.0, 180.0)
    mount_time_s: float = 1200.0
    task_time_s: float = 30.0
    second_look_s: float = 15.0
    display_time_s: float = 10.0
    slip_probability: float = 0.01

    def __post_init__(self) -> None:
        """Raise `ValueError` for a scale step that is not positive."""
        if self.resolution_rad <= 0.0:
            raise ValueError(f"state a positive resolution of the scale, not {self.resolution_rad} rad")


class ScriptedOperator:
    """A `drivers.person.WatchingPerson` who carries out `prompt.action` on the world and answers.

    Random numbers are keyed by the world's seed and by the step in the prompt's id (the part before "#"), so a step
    repeated in another process gives the same result. A repeated question ("…#2") is answered without a slip and,
    unless an encoder reads the head, without turning the head again.
    """

    def __init__(self, world: World, settings: OperatorSettings | None = None) -> None:
        self._world = world
        self._settings = settings or OperatorSettings()
        self._turned_for: str | None = None
        self.meanwhile: Callable[[], None] | None = None

    def ask(self, prompt: Prompt) -> Answer:
        """Carry out the prompt's action, let its duration pass, and return the answer.

        Raises `NoAnswer` for a prompt with neither a known action nor a default.
        """
        action, world, text = prompt.action, self._world, ""
        if (time := _TAKES.get(action["do"])) is not None:
            self._pass_time(getattr(self._settings, time))
        if action["do"] == "mount":
            world.mount(action["installation"], action.get("series", 1))
            self._turned_for = None
        elif action["do"] == "turn":
            text = self._turn(prompt, action)
        elif action["do"] == "set_temperature":
            world.set_chamber(action["target_c"])
        elif action["do"] == "read_temperature":
            shown = {"meter": world.meters_c, "room": world.room_c}.get(action.get("of", ""))
            text = f"{world.block_c if shown is None else shown():.2f}"
        elif action["do"] == "read_head":
            text = scale_text(self._on_scale(world.scale_angle_rad) / ARCSEC)
        elif action["do"] == "select_input":
            world.select_input(action["source"], action.get("reference_v"))
        elif action["do"] == "place_level":
            world.place_level(turned=action["turned"])
        elif action["do"] == "read_level":
            world.place_level(turned=action["turned"])
            text = f"{world.level_shows_rad(action['axis']) / action['division_rad']:.1f}"
        elif action["do"] == "level_platform":
            world.level_platform(action["installation"], action["series"])
        elif action["do"] in ("set_supply", "switch_supply", "read_supply"):
            text = work_supply(world, action)
        elif action["do"] != "confirm_reading":  # what was typed is what the display shows
            text = _default(prompt)
        return Answer(prompt.id, text or _confirmation(prompt))

    def turn_to(
        self, prompt_id: str, angle_rad: float, direction: Direction, backoff_rad: float | None = None
    ) -> None:
        """Turn the head until its scale shows `angle_rad`, in the time that `ask` would take for this prompt.

        With `backoff_rad`, for a head that an encoder reads, the operator first turns it to twice `backoff_rad`
        before the angle.
        """
        generator = self._generator(prompt_id.partition("#")[0])
        generator.normal()  # skip the setting error, so that the next number is the duration, as in `_turn`
        duration_s = float(generator.uniform(*self._settings.turn_time_s))
        if backoff_rad is not None:
            self._approach(angle_rad, direction * backoff_rad, duration_s)
            return
        self._pass_time(duration_s)
        self._world.turn(angle_rad, direction)

    def _turn(self, prompt: Prompt, action: TurnHead) -> str:
        step, _, attempt = prompt.id.partition("#")
        settings = self._settings
        generator = self._generator(step)
        deviation_rad = float(generator.normal(0.0, settings.setting_deviation_rad))
        duration_s = float(generator.uniform(*settings.turn_time_s))
        set_rad = self._on_scale(action["target_rad"] + deviation_rad)
        slips = attempt in ("", "1") and generator.random() < settings.slip_probability
        if "read_by" in action:
            side = -1.0 if slips and prompt.kind is PromptKind.CONFIRM else 1.0
            way_rad = side * action["direction"] * action.get("backoff_rad", 0.0)
            self._approach(set_rad, way_rad, duration_s)
            if action.get("hands_free"):
                self._wait_for_encoder()
        elif self._turned_for == step:
            self._pass_time(settings.second_look_s)
        else:
            if "by_way_of_rad" in action:
                self._world.turn(action["by_way_of_rad"], action["direction"])
                self._pass_time(settings.second_look_s)
            self._pass_time(duration_s)
            self._world.turn(set_rad, action["direction"])
            self._turned_for = step
        if prompt.kind is PromptKind.CONFIRM:
            return _confirmation(prompt)
        return scale_text(set_rad / ARCSEC + (float(generator.choice(_SLIPS_ARCSEC)) if slips else 0.0))

    def _on_scale(self, angle_rad: float) -> float:
        """Return an angle rounded to the step of the scale, rad."""
        return round(angle_rad / self._settings.resolution_rad) * self._settings.resolution_rad

    def _approach(self, angle_rad: float, backoff_rad: float, duration_s: float) -> None:
        """Turn to twice `backoff_rad` (sign: direction, reversed by a slip) before the angle, then to it."""
        for end_rad, share in ((angle_rad - 2.0 * backoff_rad, 0.6), (angle_rad, 0.4)):
            way_rad = abs(end_rad - self._world.scale_angle_rad)
            if way_rad > 0.0:
                self._world.move_head(end_rad, way_rad / (share * duration_s))
            self._pass_time(share * duration_s)

    def _wait_for_encoder(self) -> None:
        """Call `meanwhile`, with the head at rest, until it is None, for at most `LONGEST_WAIT_S`."""
        end_s = self._world.clock.now_s() + LONGEST_WAIT_S
        while self.meanwhile is not None and self._world.clock.now_s() < end_s:
            self._world.clock.sleep(REST_LOOK_S)
            self.meanwhile()

    def _generator(self, step: str) -> np.random.Generator:
        return keyed_generator(self._world.settings.seed, "operator", "turn", step)

    def _pass_time(self, duration_s: float) -> None:
        clock = self._world.clock
        if self.meanwhile is None:
            clock.sleep(duration_s)
            return
        end_s = clock.now_s() + duration_s
        while (left_s := end_s - clock.now_s()) > 0.0:
            clock.sleep(min(LOOK_S, left_s))
            self.meanwhile()


def scale_text(angle_arcsec: float) -> str:
    """Format an angle as read from the scale and typed: "45 00 03", "-0 00 02"; rounded to 0.001″."""
    thousandths = round(abs(angle_arcsec) * 1000.0)
    seconds, fraction = divmod(thousandths, 1000)
    minutes, seconds = divmod(seconds, 60)
    degrees, minutes = divmod(minutes, 60)
    sign = "-" if angle_arcsec < 0.0 and thousandths else ""
    decimals = f".{fraction:03d}".rstrip("0") if fraction else ""
    return f"{sign}{degrees} {minutes:02d} {seconds:02d}{decimals}"


def _confirmation(prompt: Prompt) -> str:
    if prompt.default is not None:
        return prompt.default
    return prompt.choices[0] if prompt.choices else "yes"  # the first choice: "untouched"


def _default(prompt: Prompt) -> str:
    if prompt.default is not None:
        return prompt.default
    wanted = (
        "a confirmation" if prompt.kind is PromptKind.CONFIRM else f"an answer of kind {prompt.kind.value!r}"
    )
    raise NoAnswer(
        "operator",
        f"the scripted operator has no answer to {prompt.text!r}, which wants {wanted}",
        "give the prompt a default in the procedure, or run it with a person",
    )
