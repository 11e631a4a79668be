"""Normal gravity by latitude and height on the WGS 84 ellipsoid.

Source: NIMA TR8350.2 (2000), chapter 4, "WGS 84 ellipsoidal gravity formula": the closed formula of
Somigliana (4-1) and its continuation above the ellipsoid by a Taylor series (4-3).
"""

from __future__ import annotations

import math
from typing import Final

_EQUATOR_M_S2: Final = 9.7803253359
_SOMIGLIANA_K: Final = 0.00193185265241
_ECCENTRICITY_SQUARED: Final = 0.00669437999014
_SEMI_MAJOR_M: Final = 6378137.0
_FLATTENING: Final = 1 / 298.257223563
_M: Final = 0.00344978650684


def normal_gravity_m_s2(latitude_rad: float, height_m: float = 0.0) -> float:
    """Return normal gravity in m/s² at a geodetic latitude and a height above the ellipsoid.

    Local anomalies (some 1e-4 to 1e-3 m/s²) are not in it. Raises `ValueError` for a latitude beyond the poles.
    """
    if not abs(latitude_rad) <= math.pi / 2 + 1e-9:
        raise ValueError(f"a latitude lies between -90° and 90°, not at {math.degrees(latitude_rad):g}°")
    s2 = math.sin(latitude_rad) ** 2
    on_ellipsoid = _EQUATOR_M_S2 * (1 + _SOMIGLIANA_K * s2) / math.sqrt(1 - _ECCENTRICITY_SQUARED * s2)
    h = height_m / _SEMI_MAJOR_M
    return on_ellipsoid * (1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * s2) * h + 3 * h**2)
