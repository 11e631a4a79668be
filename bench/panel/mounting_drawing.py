"""SVG drawings of the platform with the block, mounted or being turned, from the installation's model.

The view is from the end of the shaft, a little from above and the right, so that the shaft, which points away from
the viewer, is visible, too. With the head at 0°, the platform's x axis points right and its z axis up; a
rising angle turns them counterclockwise. The page's style sheet sets the colours by classes. Every axis has its
letter, so that colour alone identifies nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from html import escape
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.base.languages import message
from bench.model import Installation
from drivers.angles import format_dms

RIGHT: Final = np.array([1.0, 0.0])
UP: Final = np.array([0.0, -1.0])
AWAY: Final = np.array([0.42, -0.34])
"""Projections of unit steps right, up and away from the viewer onto the sheet, whose second axis points down."""

WIDTH, HEIGHT, CENTRE = 400, 360, np.array([190.0, 195.0])
SCALE: Final = 100.0
DISC, CUBE, AXIS, SHAFT = 1.28, 0.42, 0.98, 3.6
DEPTH: Final = 0.16
NAMED: Final = AXIS + 0.14
FOOT: Final = np.array([WIDTH / 2, HEIGHT - 12.0])


def on_sheet(point: Floats) -> Floats:
    """Return points (right, away, up), shape (..., 3), projected onto the sheet, shape (..., 2)."""
    place: Floats = CENTRE + SCALE * (point @ np.array([RIGHT, AWAY, UP]))
    return place


def turned(angle_rad: float) -> Floats:
    """Return the platform's axes x, y, z as rows (right, away, up) at an angle of the head, shape (3, 3)."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def block_axes(installation: Installation, angle_rad: float) -> Floats:
    """Return the block's axes x, y, z as rows (right, away, up) at an angle of the head, shape (3, 3)."""
    return installation.block_from_platform @ turned(angle_rad)


@dataclass
class Sheet:
    """A drawing: SVG elements in drawing order. In methods, `kind` is a CSS class, `more` further attributes."""

    shapes: list[str] = field(default_factory=list)

    def line(self, kind: str, start: Floats, end: Floats) -> None:
        """Draw a straight line between two points on the sheet."""
        (x1, y1), (x2, y2) = start, end
        self.shapes.append(f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>')

    def path(self, kind: str, points: Floats, *, closed: bool = False, more: str = "") -> None:
        """Draw a polyline through points on the sheet, shape (n, 2)."""
        d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if closed else "")
        self.shapes.append(f'<path class="{kind}" d="{d}"{more}/>')

    def words(self, kind: str, at: Floats, text: str, anchor: str = "middle") -> None:
        """Write a text at a point on the sheet."""
        self.shapes.append(
            f'<text class="{kind}" x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}" '
            f'dominant-baseline="central">{escape(text)}</text>'
        )

    def arrow(self, kind: str, points: Floats, size: float = 11.0, more: str = "") -> None:
        """Draw a polyline with an arrowhead at its end."""
        self.path(kind, points, more=more)
        end, before = points[-1], points[-2]
        along = (end - before) / max(float(np.hypot(*(end - before))), 1e-9)
        across = np.array([-along[1], along[0]])
        tip = end + along * size * 0.6
        self.path(
            f"{kind} head", np.array([tip, end - along * size * 0.5 + across * size * 0.5,
                                      end - along * size * 0.5 - across * size * 0.5]), closed=True,
        )  # fmt: skip

    def svg(self, words: str) -> str:
        """Return the drawing as SVG; `words` describe it to users who cannot see it."""
        return (
            f'<svg class="drawing" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="{escape(words)}">{"".join(self.shapes)}</svg>'
        )


def mounting(installation: Installation, angle_rad: float = 0.0) -> str:
    """Return the SVG drawing of the block mounted in an installation, with the head at an angle."""
    sheet = Sheet()
    _bench(sheet, angle_rad)
    _block(sheet, installation, angle_rad)
    sheet.words("target", FOOT, f"installation {installation.label}")
    return sheet.svg(f"installation {installation.label}: {in_words(installation, angle_rad)}")


def turn(installation: Installation | None, from_rad: float | None, to_rad: float, direction: int) -> str:
    """Return the SVG drawing of the block at the target angle, with an arrow for the turn of the head.

    `direction` is +1 for an approach with rising angle (counterclockwise), -1 with falling; `from_rad` is the
    head's present angle, None if unknown.
    """
    sheet = Sheet()
    _bench(sheet, to_rad)
    if installation is not None:
        _block(sheet, installation, to_rad)
    _way(sheet, from_rad, to_rad, direction)
    sense = message("against the clock (angle rising)" if direction > 0 else "with the clock (angle falling)")
    words = message(f"turn to {format_dms(to_rad % math.tau)}, arriving {sense}")
    if installation is not None:
        words += "; " + message(f"then {in_words(installation, to_rad)}")
    return sheet.svg(words)


def in_words(installation: Installation, angle_rad: float) -> str:
    """Return where the block's axes point, as "x points right, y points away from you along the shaft, …"."""
    said = [
        message(f"{channel} points {_where(axis)}")
        for channel, axis in zip(CHANNELS, block_axes(installation, angle_rad), strict=True)
    ]
    return ", ".join(said)


_WAYS: Final = (
    (message("right"), message("left")),
    (message("away from you along the shaft"), message("towards you along the shaft")),
    (message("up"), message("down")),
)


def _where(axis: Floats) -> str:
    """Return in words where an axis points, the largest component first; components below sin 1° are left out."""
    order = np.argsort(-np.abs(axis), kind="stable")
    return " and ".join(
        _WAYS[i][int(axis[i] < 0)] for i in order if abs(axis[i]) > math.sin(math.radians(1.0))
    )


def _circle(
    radius: float, away: float, start_rad: float = 0.0, end_rad: float = math.tau, steps: int = 72
) -> Floats:
    """Return an arc about the shaft on the sheet, shape (steps, 2).

    Angle 0 is up; angles rise counterclockwise, like those of the head. `away` is the arc's place along the shaft.
    """
    angle = np.linspace(start_rad, end_rad, steps)
    points = np.stack([-radius * np.sin(angle), np.full(steps, away), radius * np.cos(angle)], axis=-1)
    return on_sheet(points)


def _bench(sheet: Sheet, angle_rad: float) -> None:
    """Draw the shaft, the platform as a graduated disc across it, and a line for the horizontal ("level")."""
    sheet.line("shaft", on_sheet(np.array([0.0, 0.3, 0.0])), on_sheet(np.array([0.0, SHAFT, 0.0])))
    sheet.words("quiet", on_sheet(np.array([0.0, SHAFT, 0.0])) + np.array([6.0, -18.0]), message("shaft"))
    sheet.path("disc back", _circle(DISC, CUBE + DEPTH), closed=True)
    sheet.path("disc", _circle(DISC, CUBE), closed=True)
    for degrees in range(0, 360, 15):
        inner = 0.9 if degrees % 45 == 0 else 0.95
        mark = _circle(DISC * inner, CUBE, angle_rad + math.radians(degrees), steps=1)[0]
        rim = _circle(DISC, CUBE, angle_rad + math.radians(degrees), steps=1)[0]
        sheet.line("zero" if degrees == 0 else "mark", mark, rim)
    level = on_sheet(np.array([[-1.75, CUBE, -1.5], [1.75, CUBE, -1.5]]))
    sheet.line("level", level[0], level[1])
    sheet.words("quiet", level[0] + np.array([4.0, 13.0]), "level", "start")


def _block(sheet: Sheet, installation: Installation, angle_rad: float) -> None:
    """Draw the cube and the block's axes, starting with the axes that point away from the viewer."""
    frame = turned(angle_rad)
    for normal, corners in _faces(frame):
        sheet.path("face front" if normal[1] < -0.5 else "face", on_sheet(corners), closed=True)
    axes = block_axes(installation, angle_rad)
    for i in np.argsort(-axes[:, 1], kind="stable"):
        channel, axis = CHANNELS[i], axes[i]
        line = on_sheet(np.array([CUBE * 0.2 * axis, AXIS * axis]))
        sheet.arrow(f"axis {channel}", line, more=f' data-axis="{channel}"')
        aside = 10.0 if abs(axis[1]) > 0.9 else 0.0  # an axis along the shaft is short on the sheet
        sheet.words(f"letter {channel}", on_sheet(NAMED * axis) + np.array([aside, 0.0]), channel)


def _faces(frame: Floats) -> list[tuple[Floats, Floats]]:
    """Return the normal (3,) and the corners (4, 3) of each visible face of the cube; `frame` rows are its axes."""
    faces, viewed = [], np.array([-AWAY[0], 1.0, AWAY[1]])  # the direction that projects to a point
    for i in range(3):
        one, two = frame[(i + 1) % 3], frame[(i + 2) % 3]
        for sign in (1.0, -1.0):
            normal = sign * frame[i]
            corners = np.array([normal + a * one + b * two for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
            if float(normal @ viewed) < -1e-9:
                faces.append((normal, CUBE * corners))
    return faces


def _way(sheet: Sheet, from_rad: float | None, to_rad: float, direction: int) -> None:
    """Draw the turn to an angle: an arrow about the shaft that arrives in the requested direction.

    The arrow covers the last 50° of the turn or less. If the head is close to the target or beyond it, the
    head first backs off, and the arrow covers 24°.
    """
    span = math.radians(50.0)
    if from_rad is not None:
        ahead = math.remainder(to_rad - from_rad, math.tau) * direction
        span = min(span, ahead) if ahead > math.radians(12.0) else math.radians(24.0)
    sheet.arrow("way", _circle(DISC + 0.17, CUBE, to_rad - direction * span, to_rad, 24), 15.0,
                more=f' data-direction="{direction}"')  # fmt: skip
    sheet.words("target", FOOT, message(f"to {format_dms(to_rad % math.tau)}"))
