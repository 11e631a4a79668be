"""Naming of missing effects: they join the model one by one, and other families compete with each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import logsumexp, softmax

from bench.base.arrays import Floats, Ints
from bench.base.languages import message
from bench.diagnosis.candidates import Variant
from bench.diagnosis.evidence import BEYOND_BELIEF, KNOWN_SIZE, Data, Scores, Search, Threshold, Whitened
from bench.diagnosis.levels import BY_CHANCE, FARTHEST, INSEPARABLE, NEGLIGIBLE, OFTEN
from bench.model.effects import CATALOGUE

MOST_EFFECTS: Final = 5
"""Largest number of effects that one search finds: one run can hardly confirm more."""
ALIAS: Final = 1.0
"""Largest part of an effect's signature, in units of noise, that an alias of the effect leaves unexplained.

It is worth `ALIAS`**2 / 2 in ln of the odds; a noise hypothesis or a measurement must gain more than this.
"""


@dataclass(frozen=True)
class FamilyOdds:
    """The posterior probability that the family `name` is the effect found."""

    name: str
    probability: float


@dataclass(frozen=True)
class FoundEffect:
    """An effect or unnamed family that was found, in the form `variant`.

    `evidence` is ln of the Bayes factor of its family, with all other effects found in the model. `total` is ln of
    the odds that an effect is missing if the model lacks this one. `size` is the root of the decrease of
    chi-square. `odds` are the probabilities of the permitted families in its place. The readings do not exclude its
    `ties`; those in `same` have the same signature. `plainer_than` are families that include it and need more
    parameters.
    """

    variant: Variant
    evidence: float
    total: float
    size: float
    ties: tuple[str, ...] = ()
    plainer_than: tuple[str, ...] = ()
    same: tuple[str, ...] = ()
    odds: tuple[FamilyOdds, ...] = ()


@dataclass(frozen=True)
class Naming:
    """The effects found, in the order of the search."""

    found: tuple[FoundEffect, ...]

    @property
    def columns(self) -> tuple[int, ...]:
        """The indices of the columns of all effects found, in `Candidates.columns`."""
        return tuple(i for f in self.found for i in f.variant.columns)

    def parts(self) -> Iterator[tuple[FoundEffect, slice]]:
        """Yield each effect found, with the slice of its own columns among `columns`."""
        start = 0
        for found in self.found:
            stop = start + len(found.variant.columns)
            yield found, slice(start, stop)
            start = stop

    def sizes(self) -> Iterator[tuple[FoundEffect, slice]]:
        """Yield each effect found and the slice of its amplitudes (not starting states) among `columns`."""
        for found, mine in self.parts():
            yield found, slice(mine.start, mine.stop - found.variant.starts)


@dataclass(frozen=True)
class Scored:
    """The scores of all families in one data set, if the known columns are in the model.

    `left` are the data after the known columns are subtracted. `evidence` maps families to ln of the Bayes factor,
    `separate` to ln of the Bayes factor times the prior, `log_odds` to the same with forms counted as the likeliest
    effect; `total` is ln of the sum of the odds. `ratio` is the index of the most probable noise ratio.
    """

    search: Search
    left: Data
    scores: Scores
    evidence: Mapping[str, float]
    separate: Mapping[str, float]
    log_odds: Mapping[str, float]
    total: float
    ratio: int

    @classmethod
    def beside(cls, whitened: Whitened, data: Data, known: Sequence[int]) -> Scored:
        """Return the scores given the columns `known`; those of the data set last used are cached in `whitened`."""
        kept = whitened.kept
        if kept.get("data") is not data:
            kept.clear()
            kept["data"] = data
        key = tuple(sorted(known))
        scored = kept[key] = kept.get(key) or cls._beside(whitened, data, key)
        return scored

    @classmethod
    def _beside(cls, whitened: Whitened, data: Data, key: tuple[int, ...]) -> Scored:
        search, candidates = Search.beside(whitened, key), whitened.candidates
        left = search.left_over(data)
        scores = _with_tied_starts(search, left, search.score(data))
        families = scores.families(candidates)[:, 0]
        log_odds = families + candidates.log_prior
        separate = dict(zip(candidates.families, log_odds.tolist(), strict=True))
        scored = cls(
            search,
            left,
            scores,
            dict(zip(candidates.families, families.tolist(), strict=True)),
            separate,
            separate,
            float(logsumexp(log_odds)),
            int(np.argmax(scores.ratio[:, 0])),
        )
        return replace(scored, log_odds=scored._with_forms_named(candidates.log_prior))

    def _with_forms_named(self, log_prior: Floats) -> dict[str, float]:
        """Return the log odds, with the forms that the likeliest effect reproduces counted as this effect.

        The effect leaves less than `ALIAS` of their fitted signatures, so that they are no other explanation.
        """
        candidates, odds = self.search.whitened.candidates, dict(self.separate)
        best = max((family for family in odds if family in CATALOGUE), key=odds.__getitem__, default=None)
        if best is None:
            return odds
        effect, least = self.likeliest(best).plain.columns, self.total + math.log(BY_CHANCE / 10.0)
        for family, prior in zip(candidates.families, log_prior.tolist(), strict=True):
            if family in CATALOGUE or odds[family] < least:
                continue
            forms = np.array(candidates.of_family(family))
            each = self.log_odds_of(forms) + prior
            likely = np.flatnonzero(each >= least)
            left = [self.unexplained(candidates.variants[form], effect) for form in forms[likely]]
            alike = likely[np.array(left) < ALIAS]
            odds[best] = float(logsumexp([odds[best], *each[alike]]))
            odds[family] = float(logsumexp([-math.inf, *np.delete(each, alike)]))
        return odds

    def unexplained(self, form: Variant, columns: Sequence[int]) -> float:
        """Return the part, in units of noise, of a form's fitted signature that `columns` (indices) leave."""
        sizes, gram = self.amplitude(form)
        across = (
            self.search.between(self.ratio, [*columns, *form.columns])[: len(columns), len(columns) :] @ sizes
        )
        among = self.search.between(self.ratio, columns) + np.eye(len(columns)) / BEYOND_BELIEF**2
        return math.sqrt(max(float(sizes @ gram @ sizes - across @ np.linalg.solve(among, across)), 0.0))

    def best(self, among: Among | None = None) -> FoundEffect:
        """Return the family with the largest posterior odds, of those permitted by `among`, as an effect found."""
        odds = self.permitted(among)
        return self.found(max(odds, key=odds.__getitem__))

    def permitted(self, among: Among | None) -> dict[str, float]:
        """Return the log odds of the permitted families; forms count as an effect only if effects are permitted."""
        permitted = [family for family in self.log_odds if among is None or among(family)]
        odds = self.log_odds if any(family in CATALOGUE for family in permitted) else self.separate
        return {family: odds[family] for family in permitted}

    def found(self, family: str) -> FoundEffect:
        """Return a family as an effect found, in its most probable form.

        If the readings do not determine the mounting, the form has a separate value for each mounting.
        """
        variant = self._best_variant(family)
        size = math.sqrt(self.explained(variant))
        return FoundEffect(variant, self.evidence[family], self.total, size)

    def in_place_of(self, one: FoundEffect) -> Iterator[tuple[Variant, float]]:
        """Yield the likeliest form of each of the `ties` of an effect found, with its probability.

        For an unnamed effect, other forms of its family follow. Forms less probable than `BY_CHANCE` are
        omitted.
        """
        variants = self.search.whitened.candidates.variants
        odds = {found.name: found.probability for found in one.odds}
        likely = [(self.likeliest(name).plain, odds[name]) for name in one.ties]
        if not one.variant.named:
            forms = self._forms(one.variant.family)
            shares = odds[one.variant.family] * softmax([*forms.values()])
            likely += zip((variants[number] for number in forms), shares.tolist(), strict=True)
        yield from ((v, share) for v, share in likely if share >= BY_CHANCE and v != one.variant)

    def likeliest(self, family: str) -> Variant:
        """Return the most probable form of a family."""
        log_odds = self._forms(family)
        return self.search.whitened.candidates.variants[max(log_odds, key=log_odds.__getitem__)]

    def _forms(self, family: str) -> dict[int, float]:
        """Return ln of the evidence of each form of a family times its prior probability."""
        of_family = self.search.whitened.candidates.of_family(family)
        return dict(zip(of_family, self.log_odds_of(of_family).tolist(), strict=True))

    def log_odds_of(self, forms: Sequence[int] | Ints) -> Floats:
        """Return ln of the evidence of `forms` (indices) of one family times their prior probabilities."""
        share = self.search.whitened.candidates.share
        return np.asarray(self.scores.variants[forms, 0] + np.log(share[forms]))

    def _best_variant(self, family: str) -> Variant:
        variants = self.search.whitened.candidates.variants
        evidence = self._forms(family)
        best = max(evidence, key=lambda i: evidence[i])
        by_pass = family in CATALOGUE and CATALOGUE[family].per_pass
        share = np.exp(np.array(list(evidence.values())) - evidence[best])
        rivals = [i for i, part in zip(evidence, share, strict=True) if part > OFTEN * share.sum()]
        if not by_pass and any(variants[i].mounts != variants[best].mounts for i in rivals):
            # the readings do not determine the mounting: each gets its own value, with a large u
            best = max(rivals, key=lambda i: (len(variants[i].plain.columns), evidence[i]))
        # equilibrium at the start is an assumption, with which u would be too small
        started = [i for i in rivals if variants[i].starts and variants[i].plain == variants[best].plain]
        chosen = variants[started[0] if started else best]
        return chosen.plain if chosen.own else chosen

    def explained(self, variant: Variant) -> float:
        """Return the decrease of chi-square when a form joins the model."""
        amplitude, gram = self.amplitude(variant)
        return max(float(amplitude @ gram @ amplitude), 0.0)

    def amplitude(self, variant: Variant) -> tuple[Floats, Floats]:
        """Return the amplitudes (p,) of a form, with the known columns in the model, and their Gram matrix (p, p).

        The amplitudes are in plausible sizes.
        """
        columns = list(variant.columns)
        gram = self.search.between(self.ratio, columns)
        along = self.left.along[self.ratio, columns, 0]
        amplitude = np.linalg.solve(gram + np.eye(len(columns)) / KNOWN_SIZE**2, along)
        return np.asarray(amplitude, dtype=np.float64), gram


def _with_tied_starts(search: Search, left: Data, scores: Scores) -> Scores:
    """Return the scores without the forms whose starting states are too large for the amplitudes.

    A state may be at most `FARTHEST` of its standard deviations for the amplitude found, plus twice its u.
    The evidence treats both as independent. Forms of `NEGLIGIBLE` weight are not examined.
    """
    candidates = search.whitened.candidates
    evidence, ratio = scores.variants.copy(), int(np.argmax(scores.ratio[:, 0]))
    likely = evidence[:, 0] > max(evidence[:, 0].max() + np.log(NEGLIGIBLE), 0.0)
    for number in np.flatnonzero(likely).tolist():
        variant = candidates.variants[number]
        if not variant.starts:
            continue
        columns = list(variant.columns)
        spread = np.linalg.inv(search.between(ratio, columns) + np.eye(len(columns)) / KNOWN_SIZE**2)
        amplitude, u = spread @ left.along[ratio, columns, 0], np.sqrt(np.diag(spread))
        channel = np.array([candidates.kinds[column].channel for column in columns])
        sizes = len(variant.sizes)
        of_size = [np.max(np.abs(amplitude[:sizes][channel[:sizes] == c])) for c in channel[sizes:]]
        if np.any(np.abs(amplitude[sizes:]) > FARTHEST * np.array(of_size) + 2.0 * u[sizes:]):
            evidence[number] = np.finfo(np.float64).min
    return replace(scores, variants=evidence)


Among = Callable[[str], bool]
"""A function that returns whether a family may be found."""


def name(
    whitened: Whitened,
    data: Data,
    threshold: Threshold,
    most: int = MOST_EFFECTS,
    begun: Sequence[FoundEffect] = (),
    among: Among | None = None,
) -> Naming:
    """Return the effects of `find`, as a `Naming` with the odds of the permitted families in their place."""
    found = find(whitened, data, threshold, most, begun, among)
    beside = (Scored.beside(whitened, data, _columns(found, but=i)) for i in range(len(found)))
    return Naming(tuple(in_place(given, one, among) for given, one in zip(beside, found, strict=True)))


def named_again(
    whitened: Whitened,
    data: Data,
    threshold: Threshold,
    found: Sequence[FoundEffect],
    among: Among | None = None,
    kept: int = 0,
) -> Naming:
    """Return the effects `found` with their odds, each replaced by the one that fits best, given the others.

    The first `kept` are not replaced. Only families that `among` permits (None: all) replace an effect.
    """
    return name(whitened, data, threshold, 0, _re_examine(whitened, data, list(found), among, kept))


def find(
    whitened: Whitened,
    data: Data,
    threshold: Threshold,
    most: int = MOST_EFFECTS,
    begun: Sequence[FoundEffect] = (),
    among: Among | None = None,
) -> list[FoundEffect]:
    """Return the effects that act in one data set and that the model lacks, after those in `begun`.

    The search ends when the odds of a missing family are below the threshold, or after `most` more effects.
    Only families that `among` permits (None: all) are found; the odds include all families.
    """
    found, free = list(begun), len(begun)
    tried = [[f.variant for f in found]]
    while len(found) < most + free:
        scored = Scored.beside(whitened, data, _columns(found))
        if scored.total < threshold.value:
            break
        found.append(scored.best(among))
        if len(found) > 1:
            kept = free if among is not None else 0
            found = _re_examine(whitened, data, found, among, kept)
            found = needed(whitened, data, found, threshold, kept)
        if [f.variant for f in found] in tried:
            break
        tried.append([f.variant for f in found])
    return found


def _columns(found: Sequence[FoundEffect], but: int | None = None) -> list[int]:
    return [column for i, f in enumerate(found) if i != but for column in f.variant.columns]


def _re_examine(
    whitened: Whitened,
    data: Data,
    found: list[FoundEffect],
    among: Among | None,
    kept: int,
) -> list[FoundEffect]:
    """Replace effects after the first `kept` by any that fit better, given all others."""
    for _ in range(2):
        changed = False
        for i in range(kept, len(found)):
            best = Scored.beside(whitened, data, _columns(found, but=i)).best(among)
            if best.variant != found[i].variant:
                found[i], changed = best, True
        if not changed:
            break
    return found


def needed(
    whitened: Whitened, data: Data, found: list[FoundEffect], threshold: Threshold, kept: int = 0
) -> list[FoundEffect]:
    """Return the effects `found` that are necessary; the first `kept`, and at least one, always stay.

    An effect is necessary if, without it, the odds of a missing effect reach the threshold. The weakest is
    tested first.
    """
    while len(found) > max(kept, 1):
        without = [Scored.beside(whitened, data, _columns(found, but=i)) for i in range(kept, len(found))]
        weakest = int(np.argmin([scored.total for scored in without]))
        if without[weakest].total >= threshold.value:
            break
        found = [f for i, f in enumerate(found) if i != weakest + kept]
    return found


def in_place(scored: Scored, one: FoundEffect, among: Among | None = None) -> FoundEffect:
    """Return an effect found with the odds of all families permitted by `among` that could be in its place."""
    family, evidence, plain = one.variant.family, scored.evidence, one.variant.plain
    odds = ranked_odds(scored.permitted(among))
    ranked, likely = [one.name for one in odds], holding(odds)
    explained = scored.explained(plain)
    aliases = _aliases(scored, plain, explained - ALIAS**2) if explained > (2 * ALIAS) ** 2 else {}
    fewest = min(len(plain.columns), aliases.pop(family, len(plain.columns)))
    larger = [f for f, rank in aliases.items() if rank > fewest]
    plainer = [f for f in larger if CATALOGUE[f].subsystem is CATALOGUE[family].subsystem]
    ties = [f for f in likely if f != family]
    ties += [f for f in ranked if f in aliases and f not in plainer and f not in ties]
    shape = scored.likeliest(family).plain
    same = (
        _aliases(scored, shape, (1.0 - INSEPARABLE) * scored.explained(shape), most=math.inf) if ties else {}
    )
    return replace(
        one,
        evidence=evidence[family],
        total=scored.total,
        size=math.sqrt(scored.explained(one.variant)),
        ties=tuple(ties),
        plainer_than=tuple(f for f in plainer if f not in ties),
        same=tuple(f for f in ties if f in same),
        odds=tuple(odds),
    )


def ranked_odds(log_odds: Mapping[str, float]) -> list[FamilyOdds]:
    """Return the posterior probabilities of families, the most probable first, from ln of their odds."""
    ranked = sorted(log_odds.items(), key=lambda item: -item[1])
    share = softmax([log for _, log in ranked])
    return [FamilyOdds(name, p) for (name, _), p in zip(ranked, share.tolist(), strict=True)]


def holding(odds: Sequence[FamilyOdds]) -> list[str]:
    """Return the most probable families, among which the readings do not decide.

    `odds` are sorted, the largest first. The first family is returned alone if its probability is at least 1 -
    `OFTEN`. Otherwise so many families are returned that their probabilities sum to at least 1 - `BY_CHANCE`.
    """
    if odds[0].probability >= 1.0 - OFTEN:
        return [odds[0].name]
    held, chosen = 0.0, []
    for one in odds:
        chosen.append(one.name)
        held += one.probability
        if held >= 1.0 - BY_CHANCE:
            break
    return chosen


def _aliases(scored: Scored, variant: Variant, enough: float, most: float = BEYOND_BELIEF) -> dict[str, int]:
    """Return the effects that explain `enough` of a signature, with the number of parameters that each needs.

    Effects that would have to exceed `most` plausible sizes are left out.
    """
    if not variant.named:
        return {}
    search, ratio = scored.search, scored.ratio
    variants = search.whitened.candidates.variants
    across = search.along(ratio, variant.columns, scored.amplitude(variant)[0])
    least = max(1.0 / most**2, 1e-10)
    fewest: dict[str, int] = {}
    for group in search.groups:
        values = group.values[ratio]
        along = np.einsum("vpk,vp->vk", group.vectors[ratio], across[group.columns])
        taken = np.sum(along**2 / (values + least), axis=1)
        for place in np.flatnonzero(taken > enough):
            one = variants[group.members[place]]
            if one.named and one.is_plain:
                rank = int(np.count_nonzero(values[place] > least))
                fewest[one.family] = min(rank, fewest.get(one.family, rank))
    return fewest


def same_signature(naming: Naming) -> Iterator[str]:
    """Yield a sentence for each effect found that other effects would imitate exactly in these readings."""
    for one in naming.found:
        if one.same:
            at = f" in {', '.join(one.variant.mounts)}" if one.variant.mounts else ""
            yield message(
                f"{one.variant.family}{at} and {', '.join(one.same)} have the same signature in these "
                "readings, which cannot separate them at any size"
            )
