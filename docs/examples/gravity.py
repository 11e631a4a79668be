"""gravity: local gravity of a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bench.base.requests import Option, option
from bench.cli.options import command
from bench.services.errors import Refused


@dataclass(frozen=True)
class Gravity:
    """A place whose gravity is asked for."""

    latitude: Annotated[float, Option("Degrees, north positive.", argument=True)]
    height: float = option(0.0, "Metres above the ellipsoid.")


@command("bench gravity 50.449 --height 180")
def gravity(request: Gravity) -> int:
    """Normal gravity of a place, by the WGS 84 formula."""
    from math import radians

    from bench.model.geometry import normal_gravity_m_s2

    try:
        gravity_m_s2 = normal_gravity_m_s2(radians(request.latitude), request.height)
    except ValueError as error:
        raise Refused(str(error)) from error
    print(f"{gravity_m_s2:.6f} m/s²")
    return 0
