"""The paper's bench for tests; it stands with the checks of `bench validate`, which use it, too."""

from bench.validation.paper_bench import (
    ARCSEC,
    SETTING_U_RAD,
    STAND_U,
    TRUTH,
    U0,
    K,
    design,
    simulate,
    specific_force,
)

__all__ = ["ARCSEC", "SETTING_U_RAD", "STAND_U", "TRUTH", "U0", "K", "design", "simulate", "specific_force"]
