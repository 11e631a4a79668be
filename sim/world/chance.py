"""The random numbers of a simulated bench.

They never come from one running generator: each is derived from the seed, what it is for, and the step of the
procedure that needs it. A world that is set up again in a new process therefore draws the very same numbers for
the same step, whatever happened before.
"""

from __future__ import annotations

import hashlib
import threading
from collections import Counter

import numpy as np


def keyed_generator(seed: int, *key: object) -> np.random.Generator:
    """Return the generator that belongs to `seed` and `key`; equal arguments give equal numbers."""
    text = "\x1f".join(str(part) for part in (seed, *key))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(text.encode()).digest(), dtype=np.uint32))


class KeyedNumbers:
    """The numbers of a seed, by purpose and step; `told_scan` is the order of channels stated by the step."""

    def __init__(self, seed: int, lock: threading.RLock) -> None:
        self._seed = seed
        self._lock = lock
        self._step: str | None = None
        self._counts: Counter[tuple[str, ...]] = Counter()
        self.told_scan: tuple[int, ...] = ()

    def begin_step(self, key: str, scan: tuple[int, ...] = ()) -> None:
        """From now on key random numbers by this step of the procedure (its attempt included).

        `scan` holds the channels 0, 1, 2 in the order in which it reads them. Where it is not told, it is
        that of the triggers, which wires of several meters may mix up.
        """
        with self._lock:
            self._step, self.told_scan = key, scan
            self._counts.clear()

    def random(self, purpose: str, *key: object) -> np.random.Generator:
        """Return the generator for a purpose within the current step; the same each time it is asked."""
        return keyed_generator(self._seed, purpose, "step", self._step or "", *key)

    def count(self, *what: str) -> int:
        """Count an event within the current step; return its number, from 1."""
        with self._lock:
            self._counts[what] += 1
            return self._counts[what]

    def fixed_random(self, purpose: str, *key: object) -> np.random.Generator:
        """Return the generator for something drawn once for the whole world, such as a meter's gain."""
        return keyed_generator(self._seed, purpose, "world", *key)
