"""What Sphinx is taught: the directive `{picture}`, anchors of earlier editions, a last touch to built pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

from docs.generators.anchors import earlier_anchors
from docs.generators.finishing import finish
from docs.generators.pictures import DRAWINGS, FOLDER, SCHEMES, TAKEN, THERE


class Picture(SphinxDirective):
    """A drawing or a screenshot by name; the content is its caption.

    Drawings stand in the page itself. Screenshots are pairs of files, for the light and the dark theme; where the
    build found no Chromium, the page says so in their place.
    """

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
            figure += nodes.paragraph("", f"(No Chromium was found when this site was built. {TAKEN[name]})")
        else:
            figure += [
                nodes.image(uri=f"/reference/{FOLDER}/{name}-{s}.png", alt=TAKEN[name], classes=[f"only-{s}"])
                for s in SCHEMES
            ]
        if self.content:
            parsed = nodes.Element()
            self.state.nested_parse(StringList(self.content), self.content_offset, parsed)
            (caption,) = parsed.children
            figure += nodes.caption(caption.rawsource, "", *caption.children)
        return [figure]


def add_anchors(doctree: nodes.document, page: str) -> None:
    """Give each heading of a page the anchors under which it was linked before."""
    taken = {name for section in doctree.findall(nodes.section) for name in section["ids"]}
    for section in doctree.findall(nodes.section):
        added = [name for name in earlier_anchors(page, section[0].astext()) if name not in taken]
        section["ids"] += dict.fromkeys(added)
        taken.update(added)


def setup(app: Any) -> dict[str, bool]:
    """Add them to Sphinx."""
    app.add_directive("picture", Picture)
    app.connect("doctree-read", lambda app, doctree: add_anchors(doctree, f"{app.env.docname}.md"))
    app.connect("build-finished", lambda app, problem: None if problem else finish(Path(app.outdir)))
    return {"parallel_read_safe": True}
