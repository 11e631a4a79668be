"""Readings prepared for a search, and the one rule by which their noise is taken as it is.

A search begins with normal noise of one size in all channels. What is left beside all that was found says whether
it is: never what is left beside nothing, which a slip makes large in one channel. If not, all is looked for again
in the noise as it is. One run and several taken together come here with a search of their own, and whoever holds
readings against a model takes the noise that was found here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from bench.analysis.diagnosis.candidates import SLIP, Candidates
from bench.analysis.diagnosis.channels import sizes_left
from bench.analysis.diagnosis.evidence import Data, Whitened
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming, Scored, name
from bench.analysis.diagnosis.posterior import noise_size
from bench.analysis.diagnosis.repeats import Repeats
from bench.analysis.diagnosis.slow_noise import SlowNoise, beside_all_sizes, slow_noise, with_slow_noise
from bench.analysis.diagnosis.threshold import Threshold
from bench.analysis.diagnosis.weighing import WeighedDown, weigh_down
from bench.base.arrays import Floats

CLEAR: Final = 6.0
"""What is so far above the threshold is there whatever the ratio of the noises."""
HARDLY: Final = 2.0
"""A name that is no further above the threshold must reach it beside slow noise, too."""
PLAUSIBLE: Final = 1.0
"""The odds that there is slow noise, beforehand, where something seems to be missing."""
TOO_LARGE: Final = 0.7
"""Repeats that say more than the noise over this have what was found in them, as a reading that stands apart is."""
SAME_SIZE: Final = 0.1
"""Sizes of the channels' noise within such a part of each other are the same."""


@dataclass(frozen=True)
class Looked:
    """Readings made linear, the candidates in units of the noise, what is needed of the data, the threshold.

    `bend` (N,) is what was taken off the response because the readings are not linear in what was found,
    `weighed` what was because the noise has heavy tails; `slow` is noise that is among what is random.
    """

    linear: LinearSystem
    repeats: Repeats
    candidates: Candidates
    whitened: Whitened
    data: Data
    limit: Threshold
    bend: Floats
    weighed: WeighedDown | None = None
    slow: tuple[SlowNoise, ...] = ()


Prepare = Callable[[LinearSystem, Threshold, float], Looked]
"""Prepares readings for a search, with the limit of such readings and the most that their noise is."""


class Again(Protocol):
    """Looks for all again in readings that are weighed otherwise: about what `looked` is about."""

    def __call__(
        self, looked: Looked, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
    ) -> tuple[Looked, Naming]:
        """Prepare and search `linear`, with the `limit` of such readings and the `most` noise where known."""


def noise_as_it_is(looked: Looked, naming: Naming, again: Again) -> tuple[Looked, Naming]:
    """Look for all again where what is left has heavy tails, and where its channels differ.

    What explains more of the readings than all that was found, as channels with noise of their own may, stands in
    its place. Readings that are rounded alike tell nothing of their noise: that of rounding is believed.
    """
    if looked.whitened.grid.known:
        return looked, naming
    looked, naming = _own_sizes_instead(looked, naming, again)
    noise = noise_size(looked.whitened, looked.data, naming.columns)
    if noise.reading < TOO_LARGE * looked.repeats.sigma:
        looked, naming = again(looked, looked.linear, looked.limit, noise.reading)
        noise = noise_size(looked.whitened, looked.data, naming.columns)
    weighed = weigh_down(looked.linear, looked.candidates, naming, noise)
    if weighed is not None:
        # the noise is smaller for it, and the limits of the stand are larger beside it
        less = replace(looked.linear, response=looked.linear.response + weighed.pull)
        looked, naming = again(replace(looked, weighed=weighed), less, looked.limit, noise.reading)
    sizes = sizes_left(looked.linear, looked.candidates, looked.whitened, looked.data, naming.columns).sizes
    if np.max(np.abs(np.log(sizes / looked.linear.by_channel))) < SAME_SIZE:
        return looked, naming
    noise = noise_size(looked.whitened, looked.data, naming.columns)
    return again(looked, replace(looked.linear, by_channel=sizes), most=noise.reading)


def _own_sizes_instead(looked: Looked, naming: Naming, again: Again) -> tuple[Looked, Naming]:
    """Look for all again where channels with noise of their own sizes explain more than all that was found.

    A channel with more noise than the others looks as if something were missing in it alone, and what takes that up
    leaves the channels alike. What is really missing is the better explanation by far: it knows where and when.
    """
    if not naming.found or np.any(looked.linear.by_channel != 1.0):
        return looked, naming
    told = sizes_left(looked.linear, looked.candidates, looked.whitened, looked.data, ())
    if told.evidence < sum(found.total for found in naming.found):
        return looked, naming
    return again(looked, replace(looked.linear, by_channel=told.sizes))


def beside_slow_noise(looked: Looked, naming: Naming, prepare: Prepare) -> tuple[Looked, Naming]:
    """Look for all again beside slow noise, where that stands in the place of all that was found (`_instead`).

    What is found clearly is there: never does it, or what was found beside it, pass for slow noise.
    """
    strongest = max((found.total for found in naming.found), default=-np.inf)
    if looked.whitened.grid.known or strongest > looked.limit.value + CLEAR:
        return looked, naming
    noise = noise_size(looked.whitened, looked.data, naming.columns)
    slow = _instead(looked, naming, noise.reading)
    if not slow:
        return looked, naming
    again = prepare(with_slow_noise(looked.linear, slow), looked.limit, noise.reading)
    again = replace(again, bend=looked.bend, weighed=looked.weighed, slow=slow)
    return again, name(again.whitened, again.data, again.limit)


def _instead(looked: Looked, naming: Naming, noise: float) -> tuple[SlowNoise, ...]:
    """Return the slow noise that stands in the place of what was found, nothing where that holds.

    It is that of the channels in which it shows by itself. Where that explains less, what was found must reach the
    threshold beside slow noise of all channels, too, whatever its size: a name that hardly does without, and what
    has none. A slip that reaches the threshold of slips is there by that.
    """
    sure = slow_noise(looked.linear, looked.whitened, Scored.beside(looked.whitened, looked.data, ()).ratio)
    if sure and sum(one.odds for one in sure) >= sum(found.evidence for found in naming.found):
        return sure
    limit, strongest = looked.limit.value, max((found.total for found in naming.found), default=-np.inf)
    named = all(found.variant.named for found in naming.found)
    if strongest < limit or (named and strongest > limit + HARDLY) or _slipped(looked.limit, naming):
        return ()
    beside = beside_all_sizes(looked.linear, looked.whitened, noise, PLAUSIBLE)
    if beside is None or beside.total >= limit:
        return ()
    return sure or beside.slow


def _slipped(limit: Threshold, naming: Naming) -> bool:
    """Whether a slip was found that reaches the threshold of slips."""
    return any(found.variant.family == SLIP and limit.by_slip(found.of_slip) for found in naming.found)


def in_the_noise_of(looked: LinearSystem, weighed: WeighedDown | None, linear: LinearSystem) -> LinearSystem:
    """Return a system of the same readings and another model, its noise as it was found: `looked`, `weighed`.

    Of several blocks the sizes alone: their rows stand in another order.
    """
    linear = replace(linear, by_channel=looked.by_channel, by_run=looked.by_run)
    if looked.readings.block is not None:
        return linear
    pull = 0.0 if weighed is None else weighed.pull
    of_noise = looked.random[:, looked.random.shape[1] - looked.of_noise :]
    return replace(
        linear,
        response=linear.response + pull,
        random=np.column_stack([linear.random, of_noise]),
        of_noise=looked.of_noise,
    )
