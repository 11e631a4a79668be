"""A scripted operator who makes one mistake, and corrects it when the run stops and asks.

`Mistake` states what goes wrong, where, and which names are right. `_Hands` replaces the world for
`sim.world.operator.ScriptedOperator`: cables, mountings and turns are wrong until the run asks how to continue.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from random import Random
from typing import Any, Final

import numpy as np

from bench.config.procedure.plan import Plan
from bench.config.procedure.steps import Mount, Turn
from bench.model import Installation
from bench.run.expectation import orientations
from drivers.interfaces import CHANNELS, Channel, Direction
from drivers.person import Answer, Prompt
from sim.world.operator import OperatorSettings, ScriptedOperator, scale_text
from sim.world.world import World

MISREAD: Final = {"misread 1°": 3600.0, "misread 10′": 600.0, "misread 1′": 60.0}
KINDS: Final = (
    "not remounted", "remounted wrongly", "not turned", "turned to the next point", "wrong direction",
    "cables swapped", *MISREAD, "misread 360° - x", "typed",
)  # fmt: skip
TYPED: Final = (3600.0, -3600.0, 600.0, -600.0, 60.0, -60.0, None)
"""Errors, arcsec, of an angle that is typed wrongly while the head is right; None for 360° - x."""

REDO: Final = {
    "not remounted": "mount again", "remounted wrongly": "mount again", "cables swapped": "redo pass",
    "wrong direction": "redo pass",
}  # fmt: skip
"""The answer to the question how to continue, for each mistake; for all other mistakes the point is repeated."""


@dataclass(frozen=True)
class Mistake:
    """A mistake made at the step `index` of a plan.

    `label` is the actual installation, `angle_rad` the actual head angle, `off_arcsec` the error of the typed
    angle, `cables` the swapped cables. `named` are phrases; a cause is right if it contains one of them.
    """

    kind: str
    index: int
    named: tuple[str, ...]
    label: str | None = None
    angle_rad: float | None = None
    off_arcsec: float | None = None
    cables: tuple[Channel, ...] = ()


def pass_of(plan: Plan, index: int) -> str:
    """Return the installation and pass of a step, such as "2.3"."""
    step = plan.steps[index]
    return f"{step.installation}.{step.pass_number}" if isinstance(step, Turn) else f"{step.installation}.1"  # type: ignore[attr-defined]


def draw(kind: str, number: int, plan: Plan, installations: Mapping[str, Installation], seed: int) -> Mistake:
    """Draw the `number`-th mistake of a kind; the passes in which it can occur are used in turn."""
    random = Random(f"{kind} {number} {seed}")  # noqa: S311 - nothing secret
    places: dict[str, list[int]] = {}
    for index in range(len(plan.steps)):
        if _possible(kind, plan, index):
            places.setdefault(pass_of(plan, index), []).append(index)
    index = random.choice(list(places.values())[number % len(places)])
    step = plan.steps[index]
    if isinstance(step, Mount):
        return _of_mounting(kind, plan, index, step, installations, random)
    assert isinstance(step, Turn)  # noqa: S101
    return _of_turn(kind, plan, index, step, random)


def _possible(kind: str, plan: Plan, index: int) -> bool:
    step, mounting = plan.steps[index], kind in ("not remounted", "remounted wrongly")
    if isinstance(step, Mount):
        return mounting and (kind != "not remounted" or _last_mount(plan, index) is not None)
    if not isinstance(step, Turn) or mounting:
        return False
    before, after = _neighbour(plan, index, -1), _neighbour(plan, index, 1)
    target = step.target_rad
    return {
        "not turned": before is not None and not _same(before, target),
        "turned to the next point": after is not None and not _same(after, target),
        "wrong direction": before is not None and not _same(2 * before, 2 * target),
        "misread 360° - x": not _same(target, -target),
    }.get(kind, True)


def _of_mounting(
    kind: str, plan: Plan, index: int, step: Mount, installations: Mapping[str, Installation], random: Random
) -> Mistake:
    before = _last_mount(plan, index)
    if kind == "not remounted":
        return Mistake(kind, index, (f"sits in installation {before},",), label=None)
    turned = orientations(installations, step.installation)
    known = [label for label in installations if label not in (step.installation, before)]
    label = random.choice([random.choice(known), random.choice(list(turned))])
    named = label if label in turned else f"sits in installation {label},"
    return Mistake(kind, index, (named,), label=label)


def _of_turn(kind: str, plan: Plan, index: int, step: Turn, random: Random) -> Mistake:
    target, before = step.target_rad, _neighbour(plan, index, -1)
    if kind == "not turned":
        return Mistake(kind, index, _as_well(plan, index, before), angle_rad=before)
    if kind == "turned to the next point":
        after = _neighbour(plan, index, 1)
        return Mistake(kind, index, _as_well(plan, index, after), angle_rad=after)
    if kind == "wrong direction" and before is not None:
        stood = 2 * before - target
        named = _as_well(plan, index, stood)
        return Mistake(kind, index, (*named, "counts the other way") if _same(before, -before) else named)
    if kind == "cables swapped":
        pair = random.choice(list(combinations(CHANNELS, 2)))
        return Mistake(kind, index, (f"channels {pair[0]} and {pair[1]} are swapped",), cables=pair)
    if kind in MISREAD:
        off = random.choice((1, -1)) * MISREAD[kind]
        named = (f"setting is {kind.removeprefix('misread ')} off",)
        return Mistake(kind, index, named, angle_rad=target + math.radians(off / 3600))
    if kind == "misread 360° - x":
        return Mistake(kind, index, _as_well(plan, index, -target), angle_rad=-target)
    off_arcsec = random.choice(TYPED if not _same(2 * target, -2 * target) else TYPED[:-1])
    sizes = {3600: "(1°)", 600: "(10′)", 60: "(1′)"}
    words = "360° - x" if off_arcsec is None else sizes[abs(int(off_arcsec))]
    return Mistake(kind, index, (words,), off_arcsec=off_arcsec)


def _as_well(plan: Plan, index: int, stood_rad: float | None) -> tuple[str, ...]:
    """Return further right names for a head at `stood_rad`, because some mistakes give the same head angle."""
    step = plan.steps[index]
    assert isinstance(step, Turn)  # noqa: S101
    assert stood_rad is not None  # noqa: S101
    before, after = _neighbour(plan, index, -1), _neighbour(plan, index, 1)
    places = {
        "was not turned": before,
        "to the next point": after,
        "turned the wrong way": None if before is None else 2 * before - step.target_rad,
        "360° - x": -step.target_rad,
    }
    return tuple(phrase for phrase, at in places.items() if at is not None and _same(at, stood_rad))


def _neighbour(plan: Plan, index: int, way: int) -> float | None:
    """Return the angle of the turn before or after a step in the same mounting; None if there is none."""
    i = index + way
    while 0 <= i < len(plan.steps) and not isinstance(plan.steps[i], Mount):
        step = plan.steps[i]
        if isinstance(step, Turn):
            return step.target_rad
        i += way
    return None


def _last_mount(plan: Plan, index: int) -> str | None:
    steps = [step for step in plan.steps[:index] if isinstance(step, Mount)]
    return steps[-1].installation if steps else None


def _same(one: float, other: float) -> bool:
    return abs(math.remainder(one - other, math.tau)) < math.radians(0.5)


class _Hands:
    """The world as the mistaken operator acts on it: `work` and `mistake` determine the real actions."""

    def __init__(self, world: World, plan: Plan, mistake: Mistake | None) -> None:
        self._world = world
        self._mistake = mistake
        self._keys = {step.key: index for index, step in enumerate(plan.steps)}
        self._plan = plan
        self._pivot_rad: float | None = None
        self.index = -1
        self.mended = mistake is None
        if mistake is not None and mistake.label is not None:
            model = world.settings.model
            extra = orientations(model.installations, plan.steps[mistake.index].installation)  # type: ignore[attr-defined]
            model = replace(model, installations={**model.installations, **extra})
            world.settings = replace(world.settings, model=model)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def at(self, key: str) -> None:
        """Note the step whose prompt is open."""
        self.index = self._keys.get(key.partition("#")[0], self.index)
        mistake = self._mistake
        if mistake is not None and mistake.cables and not self.mended and self.index >= mistake.index:
            self._swap(mistake.cables)

    def mend(self) -> None:
        """Correct the mistake; nothing else goes wrong afterwards."""
        self.mended = True
        vars(self._world).pop("signal_v", None)

    def _swap(self, cables: Sequence[Channel]) -> None:
        exchanged = dict(zip(cables, reversed(cables), strict=True))
        true_v = type(self._world).signal_v
        world: Any = self._world

        def signal_v(channel: Channel, time_s: float | None = None) -> float:
            return true_v(world, exchanged.get(channel, channel), time_s)

        world.signal_v = signal_v

    def _wrong_now(self) -> Mistake | None:
        at_it = self._mistake is not None and self.index == self._mistake.index
        return self._mistake if at_it and not self.mended else None

    def mount(self, installation: str, series: int = 1) -> None:
        """Mount the block correctly, or as the mistake demands: not at all, or in another way."""
        wrong = self._wrong_now()
        if wrong is None:
            self._world.mount(installation, series)
        elif wrong.label is not None:
            self._world.mount(wrong.label, series)

    def turn(self, scale_angle_rad: float, direction: Direction) -> None:
        """Turn the head correctly, or as the mistake demands: not at all, elsewhere, or the wrong way."""
        mistake, stood = self._mistake, self._world.scale_angle_rad
        if self.mended or mistake is None or self.index < mistake.index:
            self._world.turn(scale_angle_rad, direction)
            return
        if mistake.kind == "wrong direction":
            self._pivot_rad = stood if self._pivot_rad is None else self._pivot_rad
            self._world.turn(2 * self._pivot_rad - scale_angle_rad, direction)
        elif self.index != mistake.index or mistake.angle_rad is None:
            self._world.turn(scale_angle_rad, direction)
        elif mistake.kind != "not turned":
            step = self._plan.steps[mistake.index]
            assert isinstance(step, Turn)  # noqa: S101
            self._world.turn(mistake.angle_rad + scale_angle_rad - step.target_rad, direction)


def _same_noise_again(world: Any) -> None:
    """Give a repeated step the random numbers of its first time, so that only the mistake makes a difference."""
    begin_step = world.begin_step
    world.begin_step = lambda key, scan=(): begin_step(key.partition("@")[0], scan)


class MistakenOperator(ScriptedOperator):
    """A scripted operator who makes one mistake, or none if it is None.

    `asked` are the questions at which the run stopped, `slips_told` the prompts that identified a typing slip.
    """

    def __init__(self, world: World, settings: OperatorSettings, plan: Plan, mistake: Mistake | None) -> None:
        self._hands = _Hands(world, plan, mistake)
        _same_noise_again(world)
        super().__init__(self._hands, replace(settings, slip_probability=0.0))  # type: ignore[arg-type]
        self._mistake = mistake
        self.asked: list[str] = []
        self.slips_told: list[str] = []

    def ask(self, prompt: Prompt) -> Answer:
        """Answer a prompt; if asked how to continue, mend the mistake and repeat the affected steps."""
        if prompt.id.startswith("halt@"):
            self.asked.append(prompt.text)
            self._hands.mend()
            self._turned_for = None  # a wrong turn is repeated
            kind = self._mistake.kind if self._mistake else ""
            # this point was repeated in vain: the wrong point is an earlier one
            again = "redo pass" if len(self.asked) > 1 else "redo point"
            return Answer(prompt.id, REDO.get(kind, again))
        self._hands.at(prompt.id)
        if "probably" in prompt.text:
            self.slips_told.append(prompt.text)
        answer = super().ask(prompt)
        mistake, attempt = self._mistake, prompt.id.partition("#")[2]
        if mistake and mistake.kind == "typed" and self._hands.index == mistake.index and attempt == "1":
            return Answer(prompt.id, self._typed_wrong(answer.text, mistake))
        return answer

    def _typed_wrong(self, text: str, mistake: Mistake) -> str:
        degrees, minutes, seconds = (float(part.lstrip("-")) for part in text.split())
        arcsec = (degrees * 3600 + minutes * 60 + seconds) * (-1 if text.startswith("-") else 1)
        wrong = 1296000 - arcsec if mistake.off_arcsec is None else arcsec + mistake.off_arcsec
        return scale_text(float(np.round(wrong % 1296000, 3)))
