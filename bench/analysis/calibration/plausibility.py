"""Whether a calibration looks like the block that was announced: signs and sizes of the scale factors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from bench.analysis.calibration.result import Calibration

FARTHEST: Final = 0.2
"""A scale factor further from its nominal value than this part of it is no tolerance of manufacture."""


def implausible(result: Calibration, nominal: Sequence[float]) -> tuple[str, ...]:
    """Return a sentence for each scale factor that contradicts its nominal value (x, y, z; V/g, with sign).

    Signals in another unit than volts are not compared; free positions alone do not show a sign.
    """
    if result.unit != "V":
        return ()
    sentences = []
    for i, (axis, announced) in enumerate(zip("xyz", nominal, strict=True)):
        found = float(result.block.K[i, i])
        most = "xyz"[int(np.argmax(np.abs(result.block.K[i])))]
        sentence = (
            f"channel {axis}: scale factor {found:.4g} V/g, but the bench file announces {announced:.4g} V/g"
        )
        prefix = round(math.log10(abs(found / announced)) / 3) if found else 0
        if prefix and abs(math.log10(abs(found / announced)) - 3 * prefix) < 0.3:
            sentence += f"; are the signals in {'mV' if prefix == 1 else 'another unit'}, and not in V?"
        elif most != axis:
            sentence += f"; it answers most to {most}: are two channels or installations swapped?"
        elif found * announced < 0 and result.triangular is None:
            sentence += "; is the pair of wires reversed?"
        elif abs(abs(found / announced) - 1) <= FARTHEST:
            continue
        else:
            sentence += "; is it the block that the bench file names?"
        sentences.append(sentence)
    return tuple(sentences)
