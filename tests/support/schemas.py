"""Results held against their JSON schemas."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Final

from jsonschema import Draft202012Validator

from bench.results.schemas import RESULTS, model_of
from docs.generators.results import FOLDER, kept_schema


class Validators(Mapping[str, Draft202012Validator]):
    """A validator for each schema by name, made when it is asked for."""

    @cache  # noqa: B019 - one for all tests
    def __getitem__(self, name: str) -> Draft202012Validator:
        schema = model_of(name).schema_of(name) if name in RESULTS else kept_schema(name)
        return Draft202012Validator(schema)

    def __iter__(self) -> Iterator[str]:
        yield from sorted({*RESULTS, *(path.stem for path in FOLDER.glob("*.json"))})

    def __len__(self) -> int:
        return len(list(self))

    def __hash__(self) -> int:
        return id(self)


VALIDATORS: Final = Validators()


def keeps_to(name: str, result: Any) -> None:
    """Fail where a result leaves its schema, with every place."""
    problems = [f"{list(e.absolute_path)}: {e.message[:200]}" for e in VALIDATORS[name].iter_errors(result)]
    assert problems == []
