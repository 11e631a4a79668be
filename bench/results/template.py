"""The templates of the pages: one way to fill them."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from bench.base.numbers import typeset
from bench.base.text import visible


def page(name: str, **content: Any) -> str:
    """Return the page that a template of this folder makes of its content.

    What a page does not give to it is an error. All is escaped, and no character in it acts unseen.
    """
    return visible(_templates().get_template(name).render(**content))


@cache
def _templates() -> Environment:
    """Return the templates, which compiles each of them once a program."""
    environment = Environment(
        loader=PackageLoader("bench.results", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["typeset"] = typeset
    return environment
