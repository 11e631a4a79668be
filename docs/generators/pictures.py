"""The directive `{picture} NAME`: a drawing or a screenshot that the build makes, with its alternative text.

Drawings stand in the page itself. Screenshots are pairs of files, for the light and the dark theme; where the build
found no Chromium, the page says so in their place.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

from docs.generators import drawings, panel_pictures, screens, terminal

FOLDER: Final = "pictures"
THERE: Final = Path(__file__).parents[1] / "reference" / FOLDER
SCHEMES: Final = ("light", "dark")

DRAWINGS: Final[dict[str, tuple[Callable[[str], str], str]]] = {
    "mountings": (
        drawings.mountings,
        "Three drawings of the platform with the block, seen from the end of the shaft with the head at 0 degrees. "
        "Installation 1: x right, y away along the shaft, z up. Installation 2: x left, y up, z away. "
        "V: as 1, turned by 45 degrees about the platform's normal.",
    ),
    "turning": (
        drawings.turning,
        "Two drawings of the head at 45 degrees: reached with rising angle, counterclockwise, and with falling angle.",
    ),
    "wiring": (
        drawings.wiring,
        "Each channel of the block goes with signal and return to HI and LO of its own voltmeter, the shield connected "
        "at the meter's end only; two rails and ground come from the power supply; a Pt100 goes to the thermometer; "
        "each instrument has its own address at the computer.",
    ),
    "stand": (
        drawings.stand,
        "The stand of the paper's figure 4 with its eleven numbered parts, and beside it the bench file's key of each.",
    ),
    "rules": (
        drawings.rules,
        "A scale of the error: pass up to the limit less the guard band, conditional pass up to the limit, conditional "
        "fail up to the limit plus the guard band, fail beyond.",
    ),
    "learned": (
        drawings.learned,
        "For each angle of the stand the limit that the bench file states as a band, and within it the mean with 2u "
        "that three dry runs tell.",
    ),
    "session": (terminal.shown, "A terminal session: a dry run, its verdict, and the diagnosis of a faulty bench."),
}
"""Drawings by name: what makes each, and its alternative text."""
TAKEN: Final[dict[str, str]] = {
    **screens.PICTURES,
    **panel_pictures.PICTURES,
    "certificate": "Page 1 of a certificate: laboratory, customer, unit, the twelve coefficients with U, and the statement "
    "of conformity with its rule.",
}  # fmt: skip
"""Screenshots by name, with their alternative texts; `example_certificate` writes the last."""


def write_all() -> None:
    """Take all screenshots anew; those of an earlier build go."""
    shutil.rmtree(THERE, ignore_errors=True)
    panel_pictures.write_pictures(THERE)
    screens.write_screens(THERE)


class Picture(SphinxDirective):
    """A drawing or a screenshot by name; the content is its caption."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the figure. A name that no picture has is an error of the build."""
        name = self.arguments[0]
        figure = nodes.figure(classes=["picture", f"picture-{name}"])
        if name in DRAWINGS:
            draw, words = DRAWINGS[name]
            figure += nodes.raw("", draw(words), format="html")
        elif name not in TAKEN:
            raise self.error(f"there is no picture {name}: {', '.join([*DRAWINGS, *TAKEN])}")
        elif not all((THERE / f"{name}-{scheme}.png").is_file() for scheme in SCHEMES):
            figure += nodes.paragraph("", f"(No picture: no Chromium was found when this site was built. {TAKEN[name]})")
        else:
            figure += [
                nodes.image(
                    uri=f"/reference/{FOLDER}/{name}-{scheme}.png", alt=TAKEN[name], classes=[f"only-{scheme}"]
                )
                for scheme in SCHEMES
            ]
        if self.content:
            self._add_caption(figure)
        return [figure]

    def _add_caption(self, figure: nodes.Element) -> None:
        parsed = nodes.Element()
        self.state.nested_parse(StringList(self.content), self.content_offset, parsed)
        (first,) = parsed.children
        figure += nodes.caption(first.rawsource, "", *first.children)


def setup(app: Any) -> dict[str, bool]:
    """Add the directive to Sphinx."""
    app.add_directive("picture", Picture)
    return {"parallel_read_safe": True}
