"""Naming: the most plausible family joins the model, then all are scored again."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.diagnosis.candidates import SLIP, UNNAMED, Variant
from bench.diagnosis.evidence import (
    KNOWN_SIZE,
    Data,
    Scores,
    Search,
    Threshold,
    Whitened,
    beside_each,
    total_evidence,
)
from bench.model.effects import CATALOGUE

MOST_EFFECTS: Final = 5
LEAK: Final = 2.5
"""A candidate ties when it leaves no more than this, in units of noise, of what the found effect explains."""
LEAST_EXPLAINED: Final = 0.5
"""A candidate ties by its geometry only when it explains so much of the square: what is hardly larger than the
leak could be left by anything."""
FIRST_OF_PAIR: Final = 12
"""The number of effects that are tried as the first of a pair."""
PAIR_MARGIN: Final = 5.0
"""Two named effects replace an unnamed family when ln of their evidence is higher by this margin."""
ABSURD: Final = 60.0
"""A candidate that would have to be this many plausible sizes large ties with no effect."""
ANY_SIZE: Final = 1e5
SAME: Final = 1e-6
"""What leaves no more than this part of the square of what another effect puts into the readings does the same."""
LESS_PLAUSIBLE: Final = 4.0
"""A candidate ties when the ln of its evidence is no further below, and speaks for it at all: above 0."""


@dataclass(frozen=True)
class FoundEffect:
    """An effect, or an unnamed family, that was found: `evidence` is ln odds against not being there.

    `ties` are other effects (or unnamed families) that explain it as well, the more plausible first; `same` those
    among them that would put the very same into these readings; `plainer_than` those of the same subsystem that
    explain it with more parameters. `size` is the part of the readings that it explains, in units of noise (rho);
    `of_slip` ln of the ratio of likelihoods that a slip would have in its place.
    """

    variant: Variant
    evidence: float
    total: float
    size: float
    ties: tuple[str, ...] = ()
    plainer_than: tuple[str, ...] = ()
    same: tuple[str, ...] = ()
    of_slip: float = 0.0


@dataclass(frozen=True)
class Naming:
    """The finds, in order; `left` is the total evidence that something is still missing."""

    found: tuple[FoundEffect, ...]
    left: float

    @property
    def columns(self) -> tuple[int, ...]:
        """Column indices of all finds."""
        return tuple(i for f in self.found for i in f.variant.columns)

    def parts(self) -> Iterator[tuple[FoundEffect, slice]]:
        """Yield each find with the slice of its own columns among `columns`."""
        start = 0
        for found in self.found:
            stop = start + len(found.variant.columns)
            yield found, slice(start, stop)
            start = stop


@dataclass(frozen=True)
class Scored:
    """The scores of a data set beside the known columns of the present model.

    `left` are the data products after the fit of the known columns. `evidence` is the ln odds of each family,
    `total` the ln odds that anything is missing, and `of_slip` ln of the likelihood ratio of a slip. `ratio`
    is the index of the likeliest ratio of the two noise sizes.
    """

    search: Search
    left: Data
    scores: Scores
    evidence: Mapping[str, float]
    total: float
    of_slip: float
    ratio: int

    @classmethod
    def beside(cls, whitened: Whitened, data: Data, known: Sequence[int]) -> Scored:
        """Score all variants beside a model that has the `known` columns already.

        The scores of the same data are cached, as a search requests them repeatedly.
        """
        kept = _kept(whitened, data)
        key = tuple(sorted(known))
        scored = kept.pop(key, None)
        scored = cls._beside(whitened, data, key) if scored is None else scored
        kept[key] = scored
        if len(kept) > MOST_KEPT:
            del kept[next(iter(kept))]
        return scored

    @classmethod
    def _beside(cls, whitened: Whitened, data: Data, known: Sequence[int]) -> Scored:
        search = Search.beside(whitened, known)
        scores = search.score(data)
        families = scores.families(whitened.candidates)[:, 0].tolist()
        return cls(
            search,
            search.left_over(data),
            scores,
            dict(zip(whitened.candidates.families, families, strict=True)),
            float(total_evidence(scores, whitened)[0]),
            float(search.likelihood_ratio(data, whitened.candidates.slips)[0]),
            int(np.argmax(scores.ratio[:, 0])),
        )

    def best(self) -> FoundEffect:
        """Return the best family in its best form."""
        return self.found(max(self.evidence, key=lambda family: self.evidence[family]))

    def foremost(self, threshold: Threshold) -> FoundEffect | None:
        """Return what is missing before all else; None where nothing is missing.

        Where a slip alone is more than chance, and all together are not, it is the slip.
        """
        if self.total >= threshold.value:
            return self.best()
        return self.found(SLIP) if threshold.by_slip(self.of_slip) else None

    def found(self, family: str) -> FoundEffect:
        """Return the `family` as a find, in its form with the most evidence."""
        variant = self._best_variant(family)
        size = math.sqrt(self.explained(variant))
        return FoundEffect(variant, self.evidence[family], self.total, size, of_slip=self.of_slip)

    def likeliest(self, family: str) -> Variant:
        """Return the form of a family that has the most evidence."""
        evidence = self._forms(family)
        return self.search.whitened.candidates.variants[max(evidence, key=lambda i: evidence[i])]

    def _forms(self, family: str) -> dict[int, float]:
        of_family = self.search.whitened.candidates.of_family(family)
        return {i: float(self.scores.variants[i, 0]) for i in of_family}

    def _best_variant(self, family: str) -> Variant:
        variants = self.search.whitened.candidates.variants
        evidence = self._forms(family)
        best = max(evidence, key=lambda i: evidence[i])
        rivals = [i for i in evidence if evidence[best] - evidence[i] < LESS_PLAUSIBLE]
        by_pass = family in CATALOGUE and CATALOGUE[family].per_pass
        if not by_pass and any(variants[i].mounts != variants[best].mounts for i in rivals):
            # which mounting has it cannot be told: each gets a value of its own, with the u that this deserves
            best = max(rivals, key=lambda i: (len(variants[i].columns), evidence[i]))
        return variants[best]

    def explained(self, variant: Variant) -> float:
        """Return the square of the data that a form explains, in units of the noise squared."""
        amplitude, gram = self.amplitude(variant)
        return max(float(amplitude @ gram @ amplitude), 0.0)

    def amplitude(self, variant: Variant) -> tuple[Floats, Floats]:
        """Return the sizes of a form's columns (p,) and their Gram matrix (p, p) beside what is known."""
        columns = list(variant.columns)
        gram = self.search.between(self.ratio, columns)
        along = self.left.along[self.ratio, columns, 0]
        amplitude = np.linalg.solve(gram + np.eye(len(columns)) / KNOWN_SIZE**2, along)
        return np.asarray(amplitude, dtype=np.float64), gram


MOST_KEPT: Final = 24
"""The number of scored models that are cached for the data scored last."""


def _kept(whitened: Whitened, data: Data) -> dict[tuple[int, ...], Scored]:
    """Return what is kept of these data, by the columns that the model had; of other data it is forgotten."""
    if whitened.kept.get("data") is not data:
        whitened.kept.clear()
        whitened.kept.update(data=data, scored={}, pairs={})
    scored: dict[tuple[int, ...], Scored] = whitened.kept["scored"]
    return scored


def name(
    whitened: Whitened,
    data: Data,
    threshold: Threshold,
    most: int = MOST_EFFECTS,
    begun: Sequence[FoundEffect] = (),
) -> Naming:
    """Find what is missing in one data set, `most` effects at most beside those that were `begun` with."""
    found = list(begun)
    while True:
        scored = Scored.beside(whitened, data, _columns(found))
        best = scored.foremost(threshold)
        if best is None or len(found) == most + len(begun):
            break
        pair = None if best.variant.named else _pair_kept(scored, data, best)
        found += pair or [best]
        if len(found) > 1:
            found = held(whitened, data, _re_examine(whitened, data, found, threshold), threshold)
    found_tied = tuple(
        tied(Scored.beside(whitened, data, _columns(found, but=i)), f) for i, f in enumerate(found)
    )
    return Naming(found_tied, scored.total)


def _pair_kept(scored: Scored, data: Data, unnamed: FoundEffect) -> list[FoundEffect] | None:
    """Return the cached result of `_named_pair` for these data."""
    whitened = scored.search.whitened
    _kept(whitened, data)
    pairs: dict[tuple[int, ...], list[FoundEffect] | None] = whitened.kept["pairs"]
    if scored.search.known not in pairs:
        pairs[scored.search.known] = _named_pair(scored, data, unnamed)
    return pairs[scored.search.known]


def _named_pair(scored: Scored, data: Data, unnamed: FoundEffect) -> list[FoundEffect] | None:
    """Return two effects of the catalogue that together explain what only an unnamed family does alone.

    Something free explains two effects of one channel at once, and would hide both. Which pair is the best the
    likeliest ratio of the noise sizes tells; all of them say how good it is.
    """
    search, evidence = scored.search, scored.evidence
    named = [family for family in evidence if family not in UNNAMED]
    firsts = [scored.found(f) for f in sorted(named, key=lambda f: -evidence[f])[:FIRST_OF_PAIR]]
    models = [[*search.known, *first.variant.columns] for first in firsts]
    seconds = beside_each(search.whitened.at(scored.ratio), data.at(scored.ratio), models)
    families = search.whitened.candidates.families
    joint = [
        first.evidence + float(of_first.max()) if families[int(of_first.argmax())] not in UNNAMED else -np.inf
        for first, of_first in zip(firsts, seconds.T, strict=True)
    ]
    if max(joint, default=-np.inf) == -np.inf:
        return None
    first = firsts[int(np.argmax(joint))]
    second = Scored.beside(search.whitened, data, [*search.known, *first.variant.columns]).best()
    enough = first.evidence + second.evidence >= unnamed.evidence + PAIR_MARGIN
    return [first, second] if second.variant.named and enough else None


def _columns(found: list[FoundEffect], but: int | None = None) -> list[int]:
    return [column for i, f in enumerate(found) if i != but for column in f.variant.columns]


def _re_examine(
    whitened: Whitened, data: Data, found: list[FoundEffect], threshold: Threshold
) -> list[FoundEffect]:
    """Test each earlier find again beside all others, as it may have replaced another effect."""
    for _ in range(2):
        changed = False
        for i in range(len(found)):
            scored = Scored.beside(whitened, data, _columns(found, but=i))
            best = scored.foremost(threshold) or scored.best()
            if best.variant != found[i].variant:
                found[i], changed = best, True
        if not changed:
            break
    return found


def held(whitened: Whitened, data: Data, found: list[FoundEffect], threshold: Threshold) -> list[FoundEffect]:
    """Leave out, the weakest first, what is no longer needed beside the others: without it nothing is missing."""
    while len(found) > 1:
        without = [Scored.beside(whitened, data, _columns(found, but=i)) for i in range(len(found))]
        weakest = int(np.argmin([scored.total for scored in without]))
        if threshold.reached(without[weakest].total, without[weakest].of_slip):
            break
        found = [f for i, f in enumerate(found) if i != weakest]
    return found


def tied(scored: Scored, one: FoundEffect) -> FoundEffect:
    """Find which other effects would explain what `one` explains; `scored` is beside all others that were found."""
    evidence = scored.evidence
    amplitude, gram = scored.amplitude(one.variant)
    explained = float(amplitude @ gram @ amplitude)
    enough = max(explained - LEAK**2, LEAST_EXPLAINED * explained)
    smallest = _explaining(scored, one.variant, enough)
    likeliest = scored.likeliest(one.variant.family)
    same = _explaining(scored, likeliest, (1.0 - SAME) * scored.explained(likeliest), most=ANY_SIZE)
    fewest = min(len(one.variant.columns), smallest.get(one.variant.family, len(one.variant.columns)))
    ties: list[str] = []
    plainer: list[str] = []
    for family in evidence:
        if family == one.variant.family:
            continue
        near = evidence[family] > max(evidence[one.variant.family] - LESS_PLAUSIBLE, 0.0)
        # what is free explains anything: it ties by its evidence alone
        rank = None if family in UNNAMED else smallest.get(family)
        larger = rank is not None and rank > fewest
        if one.variant.named and larger and _subsystem(family) == _subsystem(one.variant.family):
            plainer.append(family)
        elif near or rank is not None:
            ties.append(family)
    return replace(
        one,
        evidence=evidence[one.variant.family],
        total=scored.total,
        of_slip=scored.of_slip,
        size=math.sqrt(max(explained, 0.0)),
        ties=tuple(sorted(ties, key=lambda f: -evidence[f])),
        plainer_than=tuple(plainer),
        same=tuple(family for family in ties if family in same and family not in UNNAMED),
    )


def _explaining(scored: Scored, variant: Variant, enough: float, most: float = ABSURD) -> dict[str, int]:
    """Return the families that explain `enough` of a signature, with the fewest numbers that it takes them.

    None of them may have to be more than `most` plausible sizes large.
    """
    search, ratio = scored.search, scored.ratio
    across = search.along(ratio, variant.columns, scored.amplitude(variant)[0])
    fewest: dict[str, int] = {}
    for group in search.groups:
        values = group.values[ratio]
        along = np.einsum("vpk,vp->vk", group.vectors[ratio], across[group.columns])
        taken = np.sum(along**2 / (values + 1.0 / most**2), axis=1)
        for place in np.flatnonzero(taken > enough):
            family = search.whitened.candidates.variants[group.members[place]].family
            rank = int(np.count_nonzero(values[place] > 1.0 / most**2))
            fewest[family] = min(rank, fewest.get(family, rank))
    return fewest


def _subsystem(family: str) -> object:
    return CATALOGUE[family].subsystem


def same_signature(naming: Naming) -> Iterator[str]:
    """Yield a sentence for each effect that was found and that others would have done the very same as."""
    for one in naming.found:
        if one.same:
            at = f" in {', '.join(one.variant.mounts)}" if one.variant.mounts else ""
            yield (
                f"{one.variant.family}{at} and {', '.join(one.same)} do the very same in all of these readings: "
                "which it is, none of them can tell at any size"
            )
