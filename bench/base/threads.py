"""How many threads the libraries of linear algebra have."""

from __future__ import annotations

import os
from typing import Final

THREADS: Final = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Where these libraries look for the number of their threads."""


def one_thread() -> None:
    """Let linear algebra have one thread, where nobody said how many: of small matrices they wait for one another.

    To be said before numpy is imported.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
