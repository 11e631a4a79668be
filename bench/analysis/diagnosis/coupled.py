"""Which rows and columns of a matrix hang together: of several blocks each has rows and coefficients of its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bench.base.arrays import Floats, Ints


def coupled(matrix: Floats) -> Iterator[tuple[Ints, Ints]]:
    """Yield rows and columns, both ascending, between which and all others a matrix (N, k) is zero.

    Every column is in one of the parts; rows of zeros are in none.
    """
    many, count = matrix.shape
    row, column = np.nonzero(matrix)
    edges = coo_array((np.ones(len(row)), (row, many + column)), shape=(many + count, many + count))
    label = connected_components(edges, directed=False)[1]
    for part in dict.fromkeys(label[many:].tolist()):
        yield np.flatnonzero(label[:many] == part), np.flatnonzero(label[many:] == part)
