"""Results held against the schemas under docs/schemas."""

from __future__ import annotations

from typing import Any, Final

from jsonschema import Draft202012Validator

from docs.generators.results import schemas

VALIDATORS: Final = {name: Draft202012Validator(schema) for name, schema in schemas().items()}


def keeps_to(name: str, result: Any) -> None:
    """Fail where a result leaves its schema, with every place."""
    problems = [f"{list(e.absolute_path)}: {e.message[:200]}" for e in VALIDATORS[name].iter_errors(result)]
    assert problems == []
