"""Checks of results against their JSON schemas."""

from functools import cache
from typing import Any

from jsonschema import Draft202012Validator

from docs.generators.schemas import schema_of


@cache
def validator(name: str) -> Draft202012Validator:
    """Return the validator of a JSON schema by name."""
    return Draft202012Validator(schema_of(name))


def keeps_to(name: str, result: Any) -> None:
    """Fail if a result deviates from its schema; the failure lists every place."""
    problems = [f"{list(e.absolute_path)}: {e.message[:200]}" for e in validator(name).iter_errors(result)]
    assert problems == []
