"""Under which conditions readings were taken: everything the forward model may depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Mount(NamedTuple):
    """One mounting of the block: the angles of the stand stay what they are as long as it lasts."""

    series: int
    installation: str

    def __str__(self) -> str:
        return self.installation if self.series == 1 else f"{self.installation}/{self.series}"


@dataclass(frozen=True)
class Conditions:
    """Arrays over n readings.

    `mount` (n,) indexes `mounts`; `angle_rad` is the head angle as read from its scale; `direction` is
    +1, -1 or 0 (not known); `time_s` and `temperature_c` are NaN where not known.
    """

    mounts: tuple[Mount, ...]
    mount: Ints
    pass_number: Ints
    point: Ints
    angle_rad: Floats
    direction: Ints
    time_s: Floats
    temperature_c: Floats

    def __len__(self) -> int:
        return len(self.angle_rad)

    @classmethod
    def of(
        cls,
        installation: Sequence[str],
        angle_rad: Sequence[float] | Floats,
        *,
        series: Sequence[int] | None = None,
        pass_number: Sequence[int] | None = None,
        point: Sequence[int] | None = None,
        direction: Sequence[int] | None = None,
        time_s: Sequence[float] | Floats | None = None,
        temperature_c: Sequence[float] | Floats | None = None,
    ) -> Conditions:
        """Build from columns of equal length; those left out are series 1, pass 1, point 1…n, not known."""
        n = len(installation)
        keys = [Mount(s, label) for s, label in zip(series or [1] * n, installation, strict=True)]
        mounts = tuple(dict.fromkeys(keys))
        ints: dict[str, Ints] = {
            "pass_number": np.asarray(pass_number or [1] * n, dtype=np.int64),
            "point": np.asarray(point or range(1, n + 1), dtype=np.int64),
            "direction": np.asarray(direction or [0] * n, dtype=np.int64),
        }
        unknown = [float("nan")] * n
        return cls(
            mounts=mounts,
            mount=np.array([mounts.index(key) for key in keys], dtype=np.int64),
            angle_rad=np.asarray(angle_rad, dtype=np.float64),
            time_s=np.asarray(unknown if time_s is None else time_s, dtype=np.float64),
            temperature_c=np.asarray(unknown if temperature_c is None else temperature_c, dtype=np.float64),
            **ints,
        )
