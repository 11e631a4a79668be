"""Drawings of the site as SVG: made from the model, a bench file and a page, so that they say what these say.

They stand in the page itself, so the style sheet gives them the colours of the light and the dark theme.
"""

from __future__ import annotations

import math
import re
import tempfile
from dataclasses import dataclass, field
from functools import cache
from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.shipped import CONFIG, shipped_folder
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, Installation, specific_force_on_platform
from bench.panel.mounting_drawing import mounting, turn

PAGES: Final = Path(__file__).parents[1]
MAIN_ANGLES: Final = (0.0, 90.0, 180.0, 270.0)


@dataclass
class Drawing:
    """A drawing of boxes, lines and words under construction."""

    width: int
    height: int
    shapes: list[str] = field(default_factory=list)

    def box(self, x: float, y: float, w: float, h: float, kind: str = "box", *words: str) -> None:
        """Draw a box with lines of words in its middle."""
        self.shapes.append(f'<rect class="{kind}" x="{x}" y="{y}" width="{w}" height="{h}" rx="5"/>')
        for i, line in enumerate(words):
            at = y + h / 2 + 17 * (i - (len(words) - 1) / 2)
            self.words(x + w / 2, at, line, "name" if i == 0 else "small")

    def line(self, kind: str, *points: tuple[float, float]) -> None:
        """Draw a line through points."""
        self.shapes.append(f'<path class="{kind}" d="M{"L".join(f"{x:g} {y:g}" for x, y in points)}"/>')

    def words(self, x: float, y: float, text: str, kind: str = "small", anchor: str = "middle") -> None:
        """Write a text, its middle at a height."""
        self.shapes.append(
            f'<text class="{kind}" x="{x:g}" y="{y:g}" text-anchor="{anchor}" '
            f'dominant-baseline="central">{escape(text)}</text>'
        )

    def number(self, x: float, y: float, number: int) -> None:
        """Write the number of a part in a circle."""
        self.shapes.append(f'<circle class="tag" cx="{x:g}" cy="{y:g}" r="12"/>')
        self.words(x, y, str(number), "small")

    def svg(self, words: str) -> str:
        """Return the drawing; `words` describe it for readers who cannot see it."""
        return (
            f'<svg class="plan" viewBox="0 0 {self.width} {self.height}" role="img" '
            f'aria-label="{escape(words)}">{"".join(self.shapes)}</svg>'
        )


def _shipped(name: str) -> BenchFile:
    return load_bench(shipped_folder(CONFIG) / f"{name}.yaml")


def verification() -> Installation:
    """Return the installation of the verification points as the paper's bench file states it."""
    return _shipped("paper-stand").installation_models()["V"]


def forces(installation: Installation, angle_deg: float) -> list[float]:
    """Return the specific force on the block's axes at an angle of the head, g, by the model without errors."""
    on_platform = specific_force_on_platform(np.radians([angle_deg]), np.zeros((1, 5)))[0]
    return [float(one) for one in installation.block_from_platform @ on_platform]


def mountings(words: str) -> str:
    """Return the drawings of installations 1, 2 and V, with what each axis feels at four angles."""
    shown = (INSTALLATION_1, INSTALLATION_2, verification())
    drawings = "".join(f"<div>{mounting(one)}</div>" for one in shown)
    heads = "".join(f'<th scope="col" colspan="3">installation {one.label}</th>' for one in shown)
    letters = "".join(f'<th scope="col">{channel}</th>' for _ in shown for channel in CHANNELS)
    rows = "".join(
        f'<tr><th scope="row">{angle:g}°</th>'
        + "".join(f"<td>{_signed(force)}</td>" for one in shown for force in forces(one, angle))
        + "</tr>"
        for angle in MAIN_ANGLES
    )
    return (
        f'<div class="drawings" role="group" aria-label="{escape(words)}">{drawings}</div>'
        '<div class="table-wrapper docutils container" tabindex="0"><table class="docutils">'
        f"<caption>Specific force on the block's axes, g</caption><thead><tr><td></td>{heads}</tr>"
        f'<tr><th scope="col">head</th>{letters}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _signed(force: float) -> str:
    rounded = round(force, 3)
    return "0" if rounded == 0 else f"{rounded:+.3g}".replace("-", "−")


def turning(words: str) -> str:
    """Return drawings of a rising and a falling approach to 45°."""
    target = math.radians(45.0)
    drawn = (turn(INSTALLATION_1, None, target, direction) for direction in (1, -1))
    return f'<div class="drawings" role="group" aria-label="{escape(words)}">' + "".join(
        f"<div>{one}</div>" for one in drawn
    ) + "</div>"  # fmt: skip


def wiring(words: str) -> str:
    """Return the wiring of the shipped `bench-stand`: signals, supply, thermometer, wires to the computer."""
    bench = _shipped("bench-stand")
    sheet = Drawing(860, 420)
    sheet.box(20, 60, 150, 300)
    sheet.words(60, 210, "block", "name")
    for i, channel in enumerate(CHANNELS):
        (meter,) = (m for m in bench.instruments.voltmeters if channel in m.channels)
        y = 95 + 62 * i
        sheet.line(f"wire {channel}", (170, y - 8), (330, y - 8))
        sheet.line("wire", (170, y + 8), (330, y + 8))
        sheet.line("shield", (182, y - 17), (318, y - 17), (318, y + 17), (182, y + 17))
        sheet.line("shield", (318, y + 17), (318, y + 8))  # at the meter's end alone
        sheet.words(156, y - 8, channel, "name", "end")
        sheet.words(156, y + 9, "return", "small", "end")
        sheet.words(250, y - 27, "shield", "small")
        sheet.box(330, y - 24, 160, 48, "box", f"voltmeter {channel}", "HI, LO")
        _to_computer(sheet, y, _resource(meter))
    _rails(sheet, bench)
    return sheet.svg(words)


def _rails(sheet: Drawing, bench: BenchFile) -> None:
    supply, feed = bench.instruments.power_supply, bench.unit_under_test.supply
    if supply is None or feed is None:
        raise ValueError("bench-stand has no supply any more")
    sheet.box(330, 262, 160, 74, "box", "power supply", *(f"output {r.output}: {r.name}" for r in feed.rails))
    for i, rail in enumerate(feed.rails):
        y = 282 + 18 * i
        sheet.line("wire", (170, y), (330, y))
        sheet.words(156, y, rail.name, "small", "end")
    sheet.line("wire", (170, 318), (330, 318))
    sheet.words(156, 318, "ground", "small", "end")
    _to_computer(sheet, 299, _resource(supply))
    sheet.box(330, 352, 160, 40, "box", "thermometer")
    sheet.line("wire", (170, 352), (230, 352), (230, 372), (330, 372))
    sheet.words(156, 345, "Pt100", "small", "end")
    _to_computer(sheet, 372, _resource(bench.instruments.thermometer))
    sheet.box(740, 60, 100, 332, "box", "computer", "bench")


def _resource(instrument: object) -> str:
    """Return the address of an instrument that has one."""
    return str(getattr(instrument, "resource"))  # noqa: B009 - not every form of its role has an address


def _to_computer(sheet: Drawing, y: float, resource: str) -> None:
    sheet.line("data", (490, y), (740, y))
    sheet.words(615, y - 10, resource, "small code")


PARTS: Final[dict[int, tuple[float, float]]] = {
    1: (70, 352), 2: (36, 60), 3: (110, 236), 4: (188, 196), 5: (330, 92), 6: (440, 120), 7: (440, 200),
    8: (440, 290), 9: (236, 130), 10: (262, 226), 11: (300, 176),
}  # fmt: skip
"""Where the number of each part stands in the drawing of the stand."""


def stand(words: str) -> str:
    """Return the stand, redrawn after the paper's Fig. 4, and beside it what stands for each part in this program.

    The second half comes from the table of the page `stand.md`.
    """
    sheet = Drawing(930, 400)
    sheet.line("shield", (16, 340), (16, 30), (500, 30), (500, 340))
    sheet.box(40, 330, 300, 44, "box")
    sheet.box(70, 170, 90, 160, "box")
    sheet.box(160, 188, 70, 16, "shade")
    sheet.box(214, 70, 170, 226, "shield")
    sheet.box(230, 120, 14, 150, "shade")
    sheet.line("wire", (244, 214), (330, 214))
    sheet.line("wire", (244, 206), (252, 206), (252, 214))
    sheet.box(262, 152, 56, 56, "box")
    for y in (120.0, 200.0, 290.0):
        sheet.box(420, y - 26, 66, 52, "box")
    sheet.line("wire", (318, 168), (396, 168), (396, 120), (420, 120))
    sheet.line("wire", (318, 190), (404, 190), (404, 200), (420, 200))
    sheet.line("data", (452, 226), (452, 264))
    sheet.line("data", (420, 290), (400, 290), (400, 316), (130, 316), (130, 330))
    for part, (x, y) in PARTS.items():
        sheet.number(x, y, part)
    sheet.words(250, 14, "after the paper's Fig. 4", "name")
    sheet.words(710, 14, "here", "name")
    for part, (name, means) in parts_of_the_page().items():
        y = 18.0 + 32 * part
        sheet.number(532, y, part)
        sheet.words(552, y - 7, name, "name", "start")
        sheet.words(552, y + 9, means, "small code", "start")
    return sheet.svg(words)


def parts_of_the_page() -> dict[int, tuple[str, str]]:
    """Return the name of each part and its place in the bench file, from the first table of `stand.md`."""
    text = (PAGES / "stand.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \| [^|]+ \| ([^|]+) \|", text, re.M)[: len(PARTS)]
    return {int(number): (name.strip(), keys.replace("`", "").strip()) for number, name, keys in rows}


def rules(words: str) -> str:
    """Return the bands of a verdict on a scale of |Δg|: the limit T, the guard band, U on one measured value."""
    sheet = Drawing(860, 190)
    guard, limit, beyond, end = 330.0, 480.0, 630.0, 820.0
    for (start, stop), kind, name in zip(
        ((40.0, guard), (guard, limit), (limit, beyond), (beyond, end)),
        ("pass", "conditional", "conditional", "fail"),
        ("pass", "conditional pass", "conditional fail", "fail"),
        strict=True,
    ):
        sheet.box(start, 60, stop - start, 46, f"band {kind}", name)
    for x, text in ((40.0, "0"), (guard, "T − w"), (limit, "limit T"), (beyond, "T + w")):
        sheet.line("wire", (x, 50), (x, 118))
        sheet.words(x, 34, text, "name")
    expanded = (limit - guard) / 0.822
    for x, y, text in ((230.0, 138.0, "every rule accepts this |Δg| ± U"),
                       (400.0, 168.0, "simple acceptance alone accepts this one")):  # fmt: skip
        sheet.line("wire", (x - expanded, y), (x + expanded, y))
        sheet.shapes.append(f'<circle class="point" cx="{x}" cy="{y}" r="5"/>')
        sheet.words(x + expanded + 10, y, text, anchor="start")
    return sheet.svg(words)


LEARNED_FROM: Final = 3
"""So many dry runs stand behind the drawing of what was learned."""
ANGLES: Final = ("axis_tilt", "zero_offset", "mounting_error", "mounting_roll")


@cache
def _learned() -> dict[str, tuple[float, float]]:
    """Return mean and u of each angle of the stand as `bench learn` finds them in dry runs, arcsec."""
    import bench

    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1, LEARNED_FROM + 1):
            bench.dry_run("paper", seed=seed, name=f"day-{seed}", runs=folder)
        names = [str(Path(folder) / f"day-{seed}") for seed in range(1, LEARNED_FROM + 1)]
        sizes = bench.learn(names, bench="paper-stand").to_dict()["sizes"]
    return {name.removesuffix(".mean"): (size["value"], size["u"]) for name, size in sizes.items()}


def learned(words: str) -> str:
    """Return the stated limit of each angle of the stand, and beside it mean and 2u that dry runs tell."""
    stated, found = _shipped("paper-stand").stand_distributions(), _learned()
    sheet = Drawing(860, 60 + 70 * len(ANGLES))
    middle, scale = 560.0, 3.1
    sheet.line("shield", (middle, 24), (middle, 40 + 70 * len(ANGLES)))
    sheet.words(middle, 12, "0″", "small")
    for i, name in enumerate(ANGLES):
        y = 60 + 70 * i
        limit = stated[name].limit or stated["mounting_error"].limit  # left out, it counts as large as that
        half = math.degrees(limit) * 3600
        mean, u = found[name]
        sheet.words(16, y, name, "name", "start")
        sheet.box(middle - scale * half, y - 9, 2 * scale * half, 18, "band conditional")
        told = f"limit ±{half:.0f}″, learned {mean + 0.0:.0f}″ ± {2 * u:.0f}″".replace("-", "−").replace(
            "−0″", "0″"
        )
        sheet.words(16, y + 19, told, "small", "start")
        sheet.line("data", (middle + scale * (mean - 2 * u), y), (middle + scale * (mean + 2 * u), y))
        sheet.shapes.append(f'<circle class="point" cx="{middle + scale * mean:.1f}" cy="{y}" r="4"/>')
    return sheet.svg(words)
