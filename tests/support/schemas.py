"""Results held against their JSON schemas."""

from functools import cache
from typing import Any

from jsonschema import Draft202012Validator

from bench.results.schemas import model_of


@cache
def validator(name: str) -> Draft202012Validator:
    """Return what validates a result, by the name of its schema."""
    return Draft202012Validator(model_of(name).schema_of(name))


def keeps_to(name: str, result: Any) -> None:
    """Fail where a result leaves its schema, with every place."""
    problems = [f"{list(e.absolute_path)}: {e.message[:200]}" for e in validator(name).iter_errors(result)]
    assert problems == []
