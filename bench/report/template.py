"""The templates of the pages: one way to load them."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from bench.base.numbers import typeset


def page_template(name: str) -> Template:
    """Return a template of this folder; what a page does not give to it is an error, and all is escaped."""
    environment = Environment(
        loader=PackageLoader("bench.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["typeset"] = typeset
    return environment.get_template(name)
