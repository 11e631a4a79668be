"""An early sign: what the early warning tells of a reading that does not fit those before it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from bench.base.arrays import CHANNELS
from bench.run.watch.expectation import Judgement

MOST_TOLD: Final = 3
"""With more causes than that, equally likely, there is no telling yet; so many are named."""


@dataclass(frozen=True)
class EarlySign:
    """A reading that does not fit those before it.

    `sentence` tells it all; `sigma` are the residuals of x, y, z in standard deviations of the expectation,
    `channels` those that stand out, `p` the probability of so large a misfit by chance; `causes` are the
    mistakes that explain it equally well, likeliest first, empty when none does; `in_a_row` counts readings
    in succession that did not fit; `at_fault` is the place of an earlier reading where that one was wrong (and
    this one fits without it: `in_a_row` is 0). `kinds` are those of the causes. `confident`: the run is to stop and
    ask (`bench.run.watch.confidence`); `wrong` is then the reading at fault (series, installation, pass, point).
    """

    sentence: str
    place: str
    channels: tuple[str, ...]
    sigma: tuple[float, ...]
    p: float
    causes: tuple[str, ...]
    in_a_row: int
    at_fault: str | None = None
    kinds: tuple[str, ...] = ()
    confident: bool = False
    wrong: tuple[int, str, int, int] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as the data of an event."""
        return asdict(self)


def misfit(judged: Judgement, channels: Sequence[str]) -> str:
    """Say by how much the channels of a reading are off."""
    parts = []
    for channel in channels:
        i = CHANNELS.index(channel)
        off_v, u_v = float(judged.residual[0, i]), math.sqrt(judged.covariance[0, i, i])
        parts.append(
            f"channel {channel} is {millivolts(off_v, '+')} from what was expected "
            f"(u = {millivolts(u_v)}, {abs(off_v) / u_v:.0f} sigma)"
        )
    return ", ".join(parts)


def why(causes: Sequence[str], at_fault: str | None) -> str:
    """Say what would explain a misfit; `at_fault` is the place of an earlier reading that was wrong."""
    if at_fault:
        mistake = f"the mistake is at {at_fault}, which does not fit the other readings"
        return f"{mistake}: {' or '.join(causes)}" if causes else mistake
    if not causes:
        return "no single mistake that is known explains it"
    if len(causes) > MOST_TOLD:
        told = " or ".join(causes[:MOST_TOLD])
        return f"{len(causes)} mistakes explain it so far, the likeliest: {told}"
    return f"probable cause: {' or '.join(causes)}"


def millivolts(value_v: float, sign: str = "") -> str:
    """Three digits, without an exponent."""
    digits = 0 if abs(value_v) >= 0.1 else 1 if abs(value_v) >= 0.01 else 2
    return f"{value_v * 1e3:{sign}.{digits}f} mV"
