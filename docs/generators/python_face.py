"""The page on `import bench`: every public name with its signature and its description."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any, Final

import bench
from docs.generators.markdown import code, prose

_INTRODUCTION: Final = """\
# Python

This page lists the names of `import bench`. Also public are `drivers.interfaces` and the names on the pages for
developers ("Writing …"). All other modules may change from one version to the next. [From Python](../python.md)
has examples.
"""


def page() -> str:
    """Return the page."""
    named = {name: getattr(bench, name) for name in bench.__all__}
    functions = [_function(name, thing) for name, thing in named.items() if inspect.isfunction(thing)]
    classes = {name: thing for name, thing in named.items() if inspect.isclass(thing)}
    results = [_class(name, thing) for name, thing in classes.items() if not issubclass(thing, Exception)]
    errors = [_class(name, thing) for name, thing in classes.items() if issubclass(thing, Exception)]
    return "\n\n".join(
        (_INTRODUCTION, "## Functions", *functions, "## What they return", *results, "## Errors", *errors)
    )


def _function(name: str, function: Any) -> str:
    signature = _signature(function)
    return f"### {name}\n\n```python\n{name}{signature}\n```\n\n{_plain(prose(function))}"


def _signature(function: Any) -> str:
    """Return a signature over as many lines as it needs, annotations as they are written."""
    parts = []
    keyword_only = False
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not keyword_only:
            keyword_only = True
            parts.append("*")
        # what is made from a request says its parameters alone: their types are those of the request's fields
        bare = parameter.annotation is parameter.empty
        annotation = "" if bare else f": {str(parameter.annotation).strip(chr(39))}"
        equals = "=" if bare else " = "
        given = "" if parameter.default is parameter.empty else f"{equals}{parameter.default!r}"
        parts.append(f"{parameter.name}{annotation}{given}")
    found = inspect.signature(function).return_annotation
    returns = "" if found is inspect.Signature.empty else f" -> {str(found).replace(chr(39), '')}"
    short = f"({', '.join(parts)}){returns}"
    return short if len(short) < 80 else "(\n" + "".join(f"    {part},\n" for part in parts) + f"){returns}"


def _class(name: str, kind: type[Any]) -> str:
    members = "\n".join(_members(kind))
    return f"### {name}\n\n{_plain(prose(kind))}" + (f"\n\n{members}" if members else "")


def _members(kind: type[Any]) -> Iterator[str]:
    """Yield a line for each public property and method that a class itself says."""
    for name, member in vars(kind).items():
        if name.startswith("_"):
            continue
        told = prose(getattr(member, "func", member) if not isinstance(member, property) else member.fget)
        if not told or not (callable(member) or hasattr(member, "func") or isinstance(member, property)):
            continue
        shown = f"{name}()" if inspect.isfunction(member) or isinstance(member, classmethod) else name
        yield f"- {code(shown)}: {' '.join(_plain(told).split())}"


def _plain(text: str) -> str:
    """Return a docstring as markdown: what looks like a heading or an emphasis stays as it is written."""
    return re.sub(r"(?<![`\w])\*(?=\w)", r"\\\*", text)
