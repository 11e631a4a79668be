"""Over which passes something may have been otherwise that does not go with a mounting: a slip, another zero."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence

from bench.model.effects.base import pass_label
from bench.readings.table import UNORIENTED, VERIFICATION, Readings

Cell = tuple[str, int]
"""A mounting and one of its passes."""


def spells(readings: Readings, *, lasting: bool) -> Iterator[tuple[str, ...]]:
    """Yield labels of what may belong together: the later passes of a mounting, one pass, a whole mounting.

    A whole mounting only where its installation was mounted more than once: of one that was not, nothing says
    that the block ever sat otherwise, and how it sat are the angles of its mounting. With `lasting` any mounting,
    and all that comes after a pass, verification points included: what stays through a remount.
    A mounting all passes of which belong to it is named by itself.
    """
    mounts = [
        label if series == 1 else f"{label}/{series}"
        for label, series in zip(readings.installation.tolist(), readings.series.tolist(), strict=True)
    ]
    kinds = readings.installation.tolist()
    rows = zip(mounts, readings.pass_number.tolist(), kinds, strict=True)
    cells = list(dict.fromkeys((mount, number) for mount, number, kind in rows if kind not in UNORIENTED))
    checked = {mount for mount, kind in zip(mounts, kinds, strict=True) if kind == VERIFICATION}
    seen: set[tuple[str, ...]] = set()
    fitted = [cell for cell in cells if cell[0] not in checked]
    of_visit = dict(zip(mounts, kinds, strict=True))
    visits = Counter(of_visit[mount] for mount in {mount for mount, _ in fitted})
    whole = {mount for mount, _ in fitted if lasting or visits[of_visit[mount]] > 1}
    for chosen in _chosen(fitted, whole, cells if lasting else []):
        labels = _labels(chosen, cells)
        if labels not in seen:
            seen.add(labels)
            yield labels


def _chosen(
    fitted: Sequence[Cell], whole: Collection[str], to_the_end: Sequence[Cell]
) -> Iterator[Sequence[Cell]]:
    for mount in dict.fromkeys(mount for mount, _ in fitted):
        own = [cell for cell in fitted if cell[0] == mount]
        yield from (own[first:] for first in range(1, len(own)))
        if len(own) > 2:  # of two passes, one is as different from the other as the other from it
            yield from ([cell] for cell in own[:-1])
        if mount in whole and len(own) < len(fitted):
            yield own
    yield from (to_the_end[first:] for first in range(1, len(to_the_end)))


def _labels(chosen: Sequence[Cell], cells: Sequence[Cell]) -> tuple[str, ...]:
    labels = []
    for mount in dict.fromkeys(mount for mount, _ in chosen):
        own = [cell for cell in chosen if cell[0] == mount]
        whole = len(own) == sum(cell[0] == mount for cell in cells)
        labels += [mount] if whole else [pass_label(*cell) for cell in own]
    return tuple(labels)
