"""Texts and numbers as a C source has them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bench.base.visible import visible


def one_line(text: str) -> str:
    """Return a name from outside so that it can neither end a comment, nor begin a line, nor act on a terminal."""
    return visible(" ".join(text.replace("*/", "* /").split())).rstrip("\\")


def comment(lines: Iterable[str]) -> str:
    """Return the inner lines of a block comment."""
    return "\n".join(f" * {line}".rstrip() for line in lines)


def single(value: np.float32) -> str:
    """Return a literal of type float."""
    text = f"{float(value):.9g}"
    return f"{text}f" if any(mark in text for mark in ".en") else f"{text}.0f"


def double(value: float) -> str:
    """Return a literal of type double that reads back to the same number."""
    return repr(float(value))
