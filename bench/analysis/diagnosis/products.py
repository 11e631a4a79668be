"""Scalar products of columns in units of the noise: from the columns themselves, or from their Gram matrix."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from bench.base.arrays import Floats, Ints


class Products(Protocol):
    """Scalar products of P columns, for each ratio of the noise sizes."""

    def across(self, columns: Ints) -> Floats:
        """Return those of some columns (k,) with all, shape (ratios, k, P)."""

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the same for one ratio, shape (k, P)."""

    def among(self, columns: Ints) -> Floats:
        """Return those of columns (…, p) with each other, shape (ratios, …, p, p)."""

    def at(self, ratio: int) -> Products:
        """Return those of one ratio alone."""


@dataclass(frozen=True)
class OfColumns:
    """From the columns `white` (ratios, N, P), which are fewer numbers where there are fewer rows than columns."""

    white: Floats

    def across(self, columns: Ints) -> Floats:
        """Return those of some columns (k,) with all, shape (ratios, k, P)."""
        return np.swapaxes(self.white[:, :, columns], 1, 2) @ self.white

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the same for one ratio, shape (k, P)."""
        return np.asarray(self.white[ratio][:, columns].T @ self.white[ratio])

    def among(self, columns: Ints) -> Floats:
        """Return those of columns (…, p) with each other, shape (ratios, …, p, p)."""
        if columns.shape[-1] == 1:
            return np.asarray(self._square[:, columns[..., 0], None, None])
        chosen = np.moveaxis(self.white[:, :, columns], 1, -2)
        return np.asarray(np.swapaxes(chosen, -1, -2) @ chosen)

    @cached_property
    def _square(self) -> Floats:
        return np.asarray(np.einsum("gnp,gnp->gp", self.white, self.white))

    def at(self, ratio: int) -> OfColumns:
        """Return those of one ratio alone."""
        return OfColumns(self.white[ratio : ratio + 1])


@dataclass(frozen=True)
class OfGram:
    """From the Gram matrix (ratios, P, P), which is fewer numbers where there are more rows than columns."""

    gram: Floats

    def across(self, columns: Ints) -> Floats:
        """Return those of some columns (k,) with all, shape (ratios, k, P)."""
        return np.asarray(self.gram[:, columns])

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the same for one ratio, shape (k, P)."""
        return np.asarray(self.gram[ratio][columns])

    def among(self, columns: Ints) -> Floats:
        """Return those of columns (…, p) with each other, shape (ratios, …, p, p)."""
        return np.asarray(self.gram[:, columns[..., :, None], columns[..., None, :]])

    def at(self, ratio: int) -> OfGram:
        """Return those of one ratio alone."""
        return OfGram(self.gram[ratio : ratio + 1])
