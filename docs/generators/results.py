"""The page on results: the JSON schemas of the models in `bench/results`, as tables and as files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from bench.base.files import to_text
from docs.generators.markdown import code, table
from docs.generators.schemas import RESULTS, schema_of

_FIRST: Final = ("calibrate", "verify", "diagnose", "budget")

_INTRODUCTION: Final = """\
# Results and the record

This page shows what `--json FILE` writes, by command, and the lines of a run's record. Each has a JSON schema
(draft 2020-12), made from the model in `bench/results`; tests compare real results with the schemas. Angles are in
degrees if the name ends in `_deg`, times in seconds. Uncertainties are standard uncertainties unless the name is
`U`.
"""


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schemas by name, those of most use first."""
    return {name: schema_of(name) for name in (*_FIRST, *sorted(RESULTS.keys() - set(_FIRST)))}


def write_schemas(folder: Path) -> None:
    """Write each schema as a file, for the site to serve."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, schema in schemas().items():
        (folder / f"{name}.json").write_text(to_text(schema), encoding="utf-8")


def page() -> str:
    """Return the page."""
    parts = [_INTRODUCTION]
    for name, schema in schemas().items():
        rows = list(_rows(schema, schema.get("$defs", {}), ""))
        lead = f"{schema['description']} <a href='../schemas/{name}.json'>JSON schema</a>."
        parts.append(f"## {schema['title']}\n\n{lead}\n\n{table(('member', 'type', 'what it is'), rows)}")
    return "\n\n".join(parts)


def _rows(schema: Mapping[str, Any], defs: Mapping[str, Any], path: str) -> Iterator[tuple[str, str, str]]:
    """Yield a row for each member, the members of objects, lists and maps below their own."""
    for name, member in schema.get("properties", {}).items():
        here = f"{path}.{name}" if path else name
        yield (
            code(here),
            _type(member, defs),
            member.get("description", "") or _resolved(member, defs).get("description", ""),
        )
        yield from _inside(member, defs, here)
    more = schema.get("additionalProperties")
    if path and isinstance(more, dict):
        yield from _inside(more, defs, f"{path}.{{name}}")


def _inside(member: Mapping[str, Any], defs: Mapping[str, Any], here: str) -> Iterator[tuple[str, str, str]]:
    inner = _resolved(member, defs)
    while "items" in inner:
        here, inner = f"{here}[]", _resolved(inner["items"], defs)
    yield from _rows(inner, defs, here)


def _resolved(member: Mapping[str, Any], defs: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a member is: a definition in place of its name, what may also be null without that."""
    if "anyOf" in member:
        member = next(kind for kind in member["anyOf"] if kind.get("type") != "null")
    if "$ref" in member:
        return _resolved(defs[member["$ref"].rpartition("/")[2]], defs)
    return member


def _type(member: Mapping[str, Any], defs: Mapping[str, Any]) -> str:
    if "enum" in member:
        return ", ".join(code(word) for word in member["enum"])
    null = " or null" if "anyOf" in member else ""
    inner = _resolved(member, defs)
    kind = inner.get("type", "any")
    if isinstance(kind, list):
        return " or ".join(kind)
    if kind == "array":
        return f"list of {_type(inner.get('items', {}), defs)}{null}"
    if kind == "object" and isinstance(inner.get("additionalProperties"), dict):
        return f"map to {_type(inner['additionalProperties'], defs)}{null}"
    return f"{kind}{null}"
