"""What stays unexplained: by how much readings scatter beyond their repeats, whether that is more than chance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.posterior import NoiseSize
from bench.analysis.diagnosis.repeats import Repeats

BY_CHANCE: Final = 0.05
"""What chance gives so often is stated as an upper limit and as no value; the limit holds in all but as many."""
OF_SETTING: Final = 2
"""Numbers by which a repeat of a setting tells of the noise: across the turn of the head."""


@dataclass(frozen=True)
class Dark:
    """Scatter beyond that of the repeats (1 σ, unit of the signal), its u, the 95 % limit, the chance of it.

    `u` and `upper` are infinite where there are no readings beside the repeats to tell.
    """

    value: float
    u: float
    upper: float
    p: float

    @classmethod
    def of(cls, noise: NoiseSize, repeats: Repeats) -> Dark:
        """Compare the noise beside all that was found with that of the repeats, which is a part of it (F test)."""
        of_repeats = OF_SETTING * repeats.freedom
        beyond = noise.freedom - of_repeats
        all2, repeats2 = noise.reading**2, repeats.sigma**2
        value = float(np.sqrt(max(all2 - repeats2, 0.0)))
        if beyond <= 0:
            return cls(value, np.inf, np.inf, 1.0)
        lack = max(noise.freedom * all2 - of_repeats * repeats2, 0.0) / beyond / repeats2
        # scatter that chance made small is no proof of less than the repeats can tell
        largest = max(lack, 1.0) / float(special.fdtri(beyond, of_repeats, BY_CHANCE))
        upper = float(np.sqrt(max(largest - 1.0, 0.0) * repeats2 * beyond / noise.freedom))
        variance = 2 * all2**2 / noise.freedom + 2 * repeats2**2 * (1 / of_repeats - 2 / noise.freedom)
        u = float(np.sqrt(variance)) / (2 * value) if value > 0.0 else float(np.sqrt(np.sqrt(variance)))
        return cls(value, u, max(upper, value), float(special.fdtrc(beyond, of_repeats, lack)))

    @property
    def there(self) -> bool:
        """Whether it is more than chance."""
        return self.p < BY_CHANCE

    def to_dict(self) -> dict[str, Any]:
        """Return what a result says of it."""
        return {
            "value": self.value if self.there else 0.0,
            "u": self.u if self.there else None,
            "upper_95": self.upper,
            "p": self.p,
        }
