"""Test the recorded level of the platform, and its benefit for calibrations.

    python -m benchmarks.levelling --levellings 1000 --runs 300

First, `bench.run.workbench` levels with a level whose zero is off by 30 arcsec in a random direction: how
often are α1 and α2 of the simulated platform within U = 2 u of the recorded values? The level is electronic
(noise, last digit, scale and axes as on the Nivel's data sheet), or a bubble that a person reads. Then the
paper's procedure is calibrated from the same readings with and without the measured level; the truth comes
from the geometry of bench/validation. The program prints the rms of (estimate - truth)/u of each coefficient, and
the reduction of u and of the scatter. The exit status is 1 if a limit is broken.
"""

import math
import sys
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration import calibrate
from bench.config.procedure.steps import Level as LevelStep
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS, INSTALLATION_1, INSTALLATION_2
from bench.readings.corrected import LevelReading, with_levels
from bench.readings.table import make_readings
from bench.run.instruments import Instruments
from bench.run.workbench import Levelling
from bench.validation.paper_bench import ARCSEC, SETTING_U_RAD, STAND_U, U0, K, design, specific_force
from benchmarks.campaign import arguments, finish, outside, rms, show_by_coefficient
from drivers.interfaces import Direction, HeadPosition, Identity, Inclination, LevelSizes
from drivers.person import Answer, Prompt

ZERO_RAD = 30.0 * ARCSEC
LEFT_RAD = 5.0 * ARCSEC
"""Half-width, rad, of the uniform distribution of the platform's tilt after levelling."""
NOISE_V = 1e-4
SETTINGS = 3
LIMITS = np.array([STAND_U[name] for name in ("axis_tilt", "zero_offset", "mounting_error")])
MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})


@dataclass
class Platform:
    """The truth of one levelling: a platform, a head with setting errors, and a level with all kinds of errors."""

    rng: np.random.Generator
    bubble: bool
    alpha: Floats = field(default_factory=lambda: np.zeros(2))
    name: str = "level"
    asks_person: bool = False
    _set_rad: float = 0.0

    def __post_init__(self) -> None:
        direction = self.rng.uniform(0.0, 2.0 * np.pi)
        self.zero = ZERO_RAD * np.array([np.cos(direction), np.sin(direction)])
        if self.bubble:
            self.sizes = LevelSizes(0.2 * 5.0 * ARCSEC, 0.05, math.radians(1.0))
            self.scale = self.rng.normal(0.0, 0.05)
        else:
            cross = math.radians(math.hypot(1.0, 2.0)) / math.sqrt(3.0)
            self.sizes = LevelSizes(math.hypot(4.7e-6, 1e-6 / math.sqrt(12.0)), 0.005 / math.sqrt(3.0), cross)
            self.scale = self.rng.uniform(-0.005, 0.005)
        self.askew = self.rng.normal(0.0, self.sizes.cross, 2)

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Set the head; its scale is off by α4, and it stops slightly off the target."""
        on_scale = round(self.rng.normal(0.0, 2.0)) * ARCSEC
        self._set_rad = on_scale + self.rng.normal(0.0, SETTING_U_RAD)
        return HeadPosition(on_scale, 1)

    def ask(self, prompt: Prompt) -> Answer:
        """Level the platform if the prompt asks for this."""
        if prompt.action["do"] == "level_platform":
            self.alpha = self.rng.uniform(-LEFT_RAD, LEFT_RAD, 2)
        return Answer(prompt.id, "yes")

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Return the platform's inclination as shown; with `turned`, the level shows it with the opposite sign."""
        tilt = self.alpha + np.array([0.0, self._set_rad])
        seen = (1.0 + self.scale) * (tilt + self.askew * tilt[::-1]) * (-1.0 if turned else 1.0) + self.zero
        if self.bubble:
            divisions = seen / ARCSEC / 5.0 + self.rng.normal(0.0, 0.2, 2)
            shown = np.round(divisions * 10.0) / 10.0 * 5.0 * ARCSEC
        else:
            shown = np.round((seen + self.rng.normal(0.0, 4.7e-6, 2)) * 1e6) / 1e6
        return Inclination(float(shown[0]), float(shown[1]))

    def open(self) -> Identity:
        """Return the identity of the level; nothing needs to be opened."""
        return Identity("none", "none")

    def close(self) -> None:
        """Do nothing, because nothing is open."""


def levellings(count: int, *, bubble: bool, settings: int = 1, seed: int = 1) -> Floats:
    """Return (found - true)/u of α1 and α2, shape (count, 2)."""
    z = np.empty((count, 2))
    for k in range(count):
        rng = np.random.default_rng([seed, int(bubble), settings, k])
        platform = Platform(rng, bubble)
        step = LevelStep("1/level", "1", 1, settings, 20.0 * ARCSEC)
        instruments = Instruments([], platform, level=platform)
        found = Levelling(instruments, platform, SETTING_U_RAD).carry_out(step)
        told = np.array([found.alpha1_arcsec, found.alpha2_arcsec]) * ARCSEC
        z[k] = (told - platform.alpha) / (np.array([found.u_alpha1_arcsec, found.u_alpha2_arcsec]) * ARCSEC)
    return z


# --- the benefit for calibrations ------------------------------------------------------------------------


def calibrations(k: int, u_level: Floats, seed: int = 2) -> tuple[Floats, Floats, Floats, Floats]:
    """Return errors and u of calibrations with the level, then without it, (12,) each."""
    rng = np.random.default_rng([seed, k])
    installation, pass_number, point, phi = design()
    angles = rng.normal(0.0, LIMITS, (2, 3))
    which = np.array([int(label) - 1 for label in installation])
    setting = rng.normal(0.0, SETTING_U_RAD, len(phi))
    one, two, three = angles[which].T
    force = specific_force(installation, phi, one, two, three, setting)
    signal = force @ K.T + U0 + rng.normal(0.0, NOISE_V, (len(phi), 3))
    time_s = np.linspace(0.0, 4.0 * 3600.0, len(phi))
    plain = make_readings(installation, pass_number, point, phi, signal, time_s=time_s)
    told = (angles[:, :2] + rng.normal(0.0, u_level, (2, 2))) / ARCSEC
    u = (float(u_level[0] / ARCSEC), float(u_level[1] / ARCSEC))
    seen = [
        LevelReading(0.0, (1, c), True, (float(t[0]), float(t[1])), u)
        for c, t in zip("12", told, strict=True)
    ]
    truth = np.concatenate([K.ravel(), U0])
    levelled, limited = (calibrate(one, MODEL, STAND_U, 9.81) for one in (with_levels(plain, seen), plain))
    with_it, without = ((one.block.vector - truth, one.u_readings) for one in (levelled, limited))
    return (*with_it, *without)


def show_levellings(count: int) -> list[str]:
    """Print how often the truth is within U; return the broken limits."""
    broken = []
    for bubble in (False, True):
        for settings in (1, SETTINGS):
            z = levellings(count, bubble=bubble, settings=settings)
            within = np.mean(np.abs(z) <= 2.0, axis=0)
            sizes, kind = rms(z), "bubble" if bubble else "electronic"
            told = f"within U α1 {within[0]:.3f}, α2 {within[1]:.3f}; rms z {sizes[0]:.3f}, {sizes[1]:.3f}"
            print(f"{kind:10} {settings} settings: {told}")
            least = min(0.94, float(stats.binom.ppf(0.001, count, 0.9545)) / count)
            broken += [f"{kind}: within U {share:.3f}" for share in within if share < least]
    return broken


def show_calibrations(runs: int) -> list[str]:
    """Print rms z, and the reduction of u and of the scatter; return the broken limits."""
    u_level = np.array([0.5, 1.2]) * ARCSEC
    columns = zip(*(calibrations(k, u_level) for k in range(runs)), strict=True)
    error, u, plain_error, plain_u = (np.array(column) for column in columns)
    z = rms(error / u)
    rows = {
        "z, levelled": z,
        "z, limits": rms(plain_error / plain_u),
        "u ratio": np.mean(u / plain_u, axis=0),
    }
    print(f"{runs} runs:       " + " ".join(f"{name:>6}" for name in COEFFICIENTS))
    show_by_coefficient({**rows, "scatter ratio": rms(error) / rms(plain_error)})
    room = 3.0 / np.sqrt(2.0 * runs)
    return outside("z", z, 0.9 - room, 1.1 + room)


def main() -> int:
    given = arguments(__doc__, levellings=1000, runs=300)
    broken = show_levellings(given.levellings)
    broken += show_calibrations(given.runs) if given.runs else []
    return finish(broken, "every bar holds")


if __name__ == "__main__":
    sys.exit(main())
