"""Several sources, each by itself: one that cannot be evaluated is named, and the others are done."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard, TypeVar

from bench.services.explained import sentence
from bench.services.source import Request, Source, check_gravity, check_places, load_sources

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Failed:
    """A source that could not be evaluated, and why, in a sentence."""

    name: str
    problem: str

    def to_dict(self) -> dict[str, str]:
        """Return what stands in the place of its result."""
        return {"source": self.name, "problem": self.problem}

    def __str__(self) -> str:
        """Return the sentence, with the source named once."""
        return self.problem if self.problem.startswith(self.name) else f"{self.name}: {self.problem}"


def attempted(name: str, work: Callable[[], R]) -> R | Failed:
    """Return what is made of a source, or why it cannot be."""
    try:
        return work()
    except Exception as error:
        return Failed(name, sentence(error))


def load_each(request: Request) -> list[Source | Failed]:
    """Read several sources, each by itself; what is wrong with one alone is raised, as `load_sources` does."""
    if len(request.sources) == 1:
        return [*load_sources(request)]
    check_gravity(request.g_m_s2)
    check_places(request)
    return [
        attempted(str(name), lambda name=name: load_sources(replace(request, sources=[name]))[0])  # type: ignore[misc]
        for name in request.sources
    ]


def each(loaded: Sequence[Source | Failed], work: Callable[[Source], R]) -> list[R | Failed]:
    """Return what is made of each source, or why it cannot be; what is wrong with one alone is raised."""
    if len(loaded) == 1:
        return [work(source) for source in done(loaded)]
    return [
        one if isinstance(one, Failed) else attempted(one.name, lambda one=one: work(one))  # type: ignore[misc]
        for one in loaded
    ]


def done(results: Iterable[T | Failed]) -> list[T]:
    """Return those that are no failures."""
    return [one for one in results if _is_done(one)]


def failures(results: Iterable[object]) -> list[Failed]:
    """Return those that are."""
    return [one for one in results if isinstance(one, Failed)]


def _is_done(one: T | Failed) -> TypeGuard[T]:
    return not isinstance(one, Failed)
