"""How far a long computation has come: told by what computes, heard by whoever shows it, or by nobody."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Listener = Callable[[str, int, int], None]
"""Is told what is computed, how many of its parts are done, and how many there are."""

quiet: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether progress and notes are to be silent, as `--quiet` asks; results, questions and errors never are."""

_T = TypeVar("_T")
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def heard_by(listener: Listener | None) -> Iterator[None]:
    """Tell a listener of all that is `tracked` while the context lasts; None: nobody."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


def tracked(parts: Iterable[_T], what: str, total: int | None = None) -> Iterator[_T]:
    """Yield the parts of a computation and tell how many are done; of a single part there is nothing to tell.

    `total` says how many there are, where `parts` have no length.
    """
    count = len(parts) if isinstance(parts, Sized) else total or 0
    listener = _listener.get() if count > 1 else None
    for done, part in enumerate(parts):
        if listener is not None:
            listener(what, done, count)
        yield part
    if listener is not None:
        listener(what, count, count)
