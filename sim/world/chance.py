"""The random numbers of a simulated bench.

Each generator is derived from the seed, its purpose and the procedure step that needs it; there is no single
running generator. A world rebuilt in a new process therefore draws the same numbers for the same step, whatever
happened before.
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
    """Random generators keyed by seed, purpose and step of the procedure.

    `told_scan` lists the channels 0, 1, 2 in the scan order that the present step stated, or is empty.
    """

    def __init__(self, seed: int, lock: threading.RLock) -> None:
        self._seed = seed
        self._lock = lock
        self._step: str | None = None
        self._counts: Counter[tuple[str, ...]] = Counter()
        self.told_scan: tuple[int, ...] = ()

    def begin_step(self, key: str, scan: tuple[int, ...] = ()) -> None:
        """From now on, key random numbers with `key`, which names a step of the procedure and its attempt.

        `scan` lists the channels 0, 1, 2 in the order in which the step reads them. If it is empty, the order of
        the triggers is used, which is not reproducible for several meters on separate wires.
        """
        with self._lock:
            self._step, self.told_scan = key, scan
            self._counts.clear()

    def random(self, purpose: str, *key: object) -> np.random.Generator:
        """Return the generator for one purpose within the current step; equal arguments give equal numbers."""
        return keyed_generator(self._seed, purpose, "step", self._step or "", *key)

    def count(self, *what: str) -> int:
        """Count an event within the current step; return its number, from 1."""
        with self._lock:
            self._counts[what] += 1
            return self._counts[what]

    def fixed_random(self, purpose: str, *key: object) -> np.random.Generator:
        """Return the generator for a property drawn once for the whole world, such as a meter's gain error."""
        return keyed_generator(self._seed, purpose, "world", *key)
