"""Python's collector of cycles kept from going through what grows by the hundred thousand and has none."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Hold the collector while many small objects are made and kept, all of which it would go through every time.

    What no cycle holds is freed as ever. As a decorator it holds the collector for a function.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
