"""One effect after the other: the most plausible family is taken into the model, then all is looked at again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import UNNAMED, Candidates, Variant
from bench.analysis.diagnosis.evidence import KNOWN_SIZE, Data, Scores, Search, Whitened
from bench.analysis.diagnosis.threshold import Threshold, total_evidence
from bench.base.arrays import Floats
from bench.model import CATALOGUE

MOST_EFFECTS: Final = 5
LEAK: Final = 2.5
"""A candidate ties when it leaves no more than this, in units of noise, of what the found effect explains."""
FIRST_OF_PAIR: Final = 12
"""So many effects are tried as the first of a pair."""
PAIR_MARGIN: Final = 5.0
"""Two names are preferred to none when ln of their evidence is so much above."""
ABSURD: Final = 60.0
"""What would have to be so many plausible sizes large ties with nothing."""
LESS_PLAUSIBLE: Final = 4.0
"""A candidate ties when the ln of its evidence is no further below."""


@dataclass(frozen=True)
class Found:
    """An effect, or an unnamed family, that was found: `evidence` is ln odds against not being there.

    `ties` are other effects (or unnamed families) that explain it as well, the more plausible first; `plainer_than`
    those of the same subsystem that explain it with more parameters. `size` is the part of the readings that
    it explains, in units of noise (rho).
    """

    variant: Variant
    evidence: float
    total: float
    size: float
    ties: tuple[str, ...] = ()
    plainer_than: tuple[str, ...] = ()


@dataclass(frozen=True)
class Naming:
    """What was found, in order; `left` is the total evidence that still something is missing."""

    found: tuple[Found, ...]
    left: float

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of all that was found."""
        return tuple(i for f in self.found for i in f.variant.columns)


def name(whitened: Whitened, data: Data, threshold: Threshold) -> Naming:
    """Find what is missing in one data set."""
    found: list[Found] = []
    while True:
        search = Search.beside(whitened, _columns(found))
        best, total = _best(search, data)
        if total < threshold.value or len(found) == MOST_EFFECTS:
            break
        pair = None if best.variant.named else _named_pair(search, data, best)
        found += pair or [best]
        if len(found) > 1:
            found = _re_examine(whitened, data, found)
    return Naming(tuple(_with_ties(whitened, data, found)), total)


def _named_pair(search: Search, data: Data, unnamed: Found) -> list[Found] | None:
    """Return two effects of the catalogue that together explain what only an unnamed family does alone.

    Something free explains two effects of one channel at once, and would hide both.
    """
    candidates = search.whitened.candidates
    scores = search.score(data)
    families = scores.families(candidates)[:, 0]
    ratio = int(np.argmax(scores.ratio[:, 0]))
    best: tuple[float, list[Found]] | None = None
    named = [i for i, family in enumerate(candidates.families) if family not in UNNAMED]
    for place in sorted(named, key=lambda i: -families[i])[:FIRST_OF_PAIR]:
        variant = _best_variant(candidates, scores, candidates.families[place])
        first = Found(variant, float(families[place]), unnamed.total, _size(search, data, variant, ratio))
        beside = Search.beside(search.whitened, [*search.known, *variant.columns])
        second, _ = _best(beside, data)
        joint = first.evidence + second.evidence
        if second.variant.named and (best is None or joint > best[0]):
            best = joint, [first, second]
    if best is None or best[0] < unnamed.evidence + PAIR_MARGIN:
        return None
    return best[1]


def _best_variant(candidates: Candidates, scores: Scores, family: str) -> Variant:
    numbers = [i for i, v in enumerate(candidates.variants) if v.family == family]
    evidence = {i: float(scores.variants[i, 0]) for i in numbers}
    best = max(numbers, key=lambda i: evidence[i])
    mounts = candidates.variants[best].mounts
    rivals = [i for i in numbers if evidence[best] - evidence[i] < LESS_PLAUSIBLE]
    if any(candidates.variants[i].mounts != mounts for i in rivals):
        # which mounting has it cannot be told: each gets a value of its own, with the u that this deserves
        best = max(rivals, key=lambda i: (len(candidates.variants[i].columns), evidence[i]))
    return candidates.variants[best]


def _columns(found: list[Found]) -> list[int]:
    return [i for f in found for i in f.variant.columns]


def _best(search: Search, data: Data) -> tuple[Found, float]:
    """Return the best variant of the best family beside what is known, and the total evidence."""
    candidates = search.whitened.candidates
    scores = search.score(data)
    total = float(total_evidence(scores, search.whitened)[0])
    families = scores.families(candidates)[:, 0]
    family = candidates.families[int(np.argmax(families))]
    variant = _best_variant(candidates, scores, family)
    size = _size(search, data, variant, int(np.argmax(scores.ratio[:, 0])))
    return Found(variant, float(families.max()), total, size), total


def _size(search: Search, data: Data, variant: Variant, ratio: int) -> float:
    left = search.left_over(data)
    amplitude, gram = _amplitude(search, left, variant, ratio)
    return float(np.sqrt(max(float(amplitude @ gram @ amplitude), 0.0)))


def _amplitude(search: Search, left: Data, variant: Variant, ratio: int) -> tuple[Floats, Floats]:
    columns = list(variant.columns)
    gram = search.cross(ratio, columns)[:, columns]
    along = left.along[ratio, columns, 0]
    amplitude = np.linalg.solve(gram + np.eye(len(columns)) / KNOWN_SIZE**2, along)
    return np.asarray(amplitude, dtype=np.float64), gram


def _re_examine(whitened: Whitened, data: Data, found: list[Found]) -> list[Found]:
    """Look at each earlier find again beside all others; it may have stood in for something else."""
    for _ in range(2):
        changed = False
        for i in range(len(found)):
            others = found[:i] + found[i + 1 :]
            best, _ = _best(Search.beside(whitened, _columns(others)), data)
            if best.variant != found[i].variant:
                found[i], changed = best, True
        if not changed:
            break
    return found


def _with_ties(whitened: Whitened, data: Data, found: list[Found]) -> list[Found]:
    result = []
    for i, one in enumerate(found):
        others = found[:i] + found[i + 1 :]
        search = Search.beside(whitened, _columns(others))
        result.append(_tied(search, data, one))
    return result


def _tied(search: Search, data: Data, one: Found) -> Found:
    """Find which other effects would explain what `one` explains."""
    candidates = search.whitened.candidates
    scores = search.score(data)
    families = scores.families(candidates)[:, 0]
    evidence = dict(zip(candidates.families, families, strict=True))
    ratio = int(np.argmax(scores.ratio[:, 0]))
    amplitude, gram = _amplitude(search, search.left_over(data), one.variant, ratio)
    explained = float(amplitude @ gram @ amplitude)
    smallest = _explaining(search, ratio, one.variant, amplitude, explained - LEAK**2)
    fewest = min(len(one.variant.columns), smallest.get(one.variant.family, len(one.variant.columns)))
    ties: list[str] = []
    plainer: list[str] = []
    for family in candidates.families:
        if family == one.variant.family:
            continue
        near = evidence[one.variant.family] - evidence[family] < LESS_PLAUSIBLE
        # what is free explains anything: it ties by its evidence alone
        rank = None if family in UNNAMED else smallest.get(family)
        larger = rank is not None and rank > fewest
        if one.variant.named and larger and _subsystem(family) == _subsystem(one.variant.family):
            plainer.append(family)
        elif near or rank is not None:
            ties.append(family)
    return replace(
        one,
        evidence=float(evidence[one.variant.family]),
        size=float(np.sqrt(max(explained, 0.0))),
        ties=tuple(sorted(ties, key=lambda f: -evidence[f])),
        plainer_than=tuple(plainer),
    )


def _explaining(
    search: Search, ratio: int, variant: Variant, amplitude: Floats, enough: float
) -> dict[str, int]:
    """Return the families that explain `enough` of a signature, with the fewest numbers that it takes them."""
    across = amplitude @ search.cross(ratio, variant.columns)
    fewest: dict[str, int] = {}
    for group in search.groups:
        values = group.values[ratio]
        along = np.einsum("vpk,vp->vk", group.vectors[ratio], across[group.columns])
        taken = np.sum(along**2 / (values + 1.0 / ABSURD**2), axis=1)
        for place in np.flatnonzero(taken > enough):
            family = search.whitened.candidates.variants[group.members[place]].family
            rank = int(np.count_nonzero(values[place] > 1.0 / ABSURD**2))
            fewest[family] = min(rank, fewest.get(family, rank))
    return fewest


def _subsystem(family: str) -> object:
    return CATALOGUE[family].subsystem
