"""Procedures that are written, and loaded or refused."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.support.procedure_texts import load_steps, mistakes_in


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Any]:
    """Load a procedure of these steps."""
    return partial(load_steps, tmp_path)


@pytest.fixture
def mistakes(tmp_path: Path) -> Callable[..., Any]:
    """Return what is wrong with a procedure of these steps."""
    return partial(mistakes_in, tmp_path)
