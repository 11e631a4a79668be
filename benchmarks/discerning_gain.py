"""Compare how many effects the procedures `discerning`, `paper` and `calibration` name, and name without a tie.

Usage: python -m benchmarks.discerning_gain [--draws 300] [--seed 1]

Readings are simulated in linear approximation. An effect of the catalogue is drawn (every family equally often,
one of its forms, normal sizes of one or three times the plausible size), with the noise of the bench, and named
as `bench diagnose` does. The hidden effects have the catalogue's own forms, which makes naming easier: the table
compares procedures, and does not predict how well effects of a real bench are named.
"""

import re
from dataclasses import replace

import numpy as np
from scipy.linalg import subspace_angles

from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.procedure.steps import Read
from bench.config.shipped import find_bench, find_procedure
from bench.diagnosis.candidates import make_candidates
from bench.diagnosis.evidence import Whitened, make_threshold
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.naming import FoundEffect, name
from bench.diagnosis.next_measurement import planned_readings
from bench.diagnosis.noise_grid import make_noise_grid
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.visibility import EffectPart, Form, ReadingDesign
from bench.model import CATALOGUE, ForwardModel
from bench.readings.table import UNORIENTED, VERIFICATION
from benchmarks.campaign import Row, Share, arguments, markdown, shares

PROCEDURES = ("paper", "calibration", "discerning")
FOR_TIES = (*PROCEDURES, "turn-12", "turn-24", "remount-90")
SIGMA_V = 15e-6
"""Noise of a reading, V."""


TIES: dict[str, tuple[str, str]] = {
    "backlash – zero_offset": ("backlash.play", "zero_offset.angle"),
    "axis_wobble (once, sine) – zero_offset": ("axis_wobble.sine*1", "zero_offset.angle"),
    "mounting_error 1 – mounting_offset 2": ("mounting_error.angle@1", "mounting_offset.angle@2"),
    "voltmeter_drift – bias_drift xyz": ("voltmeter_drift.rate", "bias_drift.rate[xyz]"),
    "cubic_nonlinearity – odd_quadratic_nonlinearity (y)": (
        "cubic_nonlinearity.K3[y]", "odd_quadratic_nonlinearity.Koq[y]",
    ),
    "quadratic_nonlinearity – scale_asymmetry (y)": ("quadratic_nonlinearity.K2[y]", "scale_asymmetry.Kabs[y]"),
    "head_ellipticity (sine) – cubic_nonlinearity xyz": ("head_ellipticity.sine", "cubic_nonlinearity.K3[xyz]"),
}  # fmt: skip
"""Pairs of forms that are hard to distinguish.

A form is written as effect, parameter, `*` harmonic, channels, `@` installation.
"""
_FORM = re.compile(r"(\w+)\.(\w+)(?:\*(\d))?(?:\[(\w+)\])?(?:@(\d))?")


def form_of(text: str) -> Form:
    """Return the form that a text, as in `TIES`, describes."""
    found = _FORM.fullmatch(text)
    if found is None:
        raise ValueError(text)
    family, parameter, harmonic, channels, mount = found.groups()
    shape = (("harmonic", float(harmonic)),) if harmonic else ()
    mounts = (mount,) if mount else ()
    where = ["xyz".index(c) for c in channels] if channels else [None]
    return tuple(EffectPart(family, parameter, shape, mounts, channel) for channel in where)


def judged(found: tuple[FoundEffect, ...], truth: str) -> tuple[dict[str, bool | None], int]:
    """Return the marks of what was found, and the number of possible names of the first effect."""
    sets = [{f.variant.family, *f.ties} for f in found if f.variant.named]
    named = 0 < len(sets) == len(found)
    alone = named and len(sets) == len(sets[0]) == 1
    marks = {
        "named": named, "in the set": any(truth in names for names in sets) if named else None,
        "alone": alone, "right": truth in sets[0] if alone else None,
    }  # fmt: skip
    return marks, len(sets[0]) if named else 0


class Trial:
    """A procedure on the paper's bench, and the naming of effects in its readings."""

    def __init__(self, procedure: str) -> None:
        bench = load_bench(find_bench("paper-stand"))
        model = ForwardModel(bench.installation_models())
        self.plan = load_procedure(find_procedure(procedure)).plan
        stand_u = {n: d.u for n, d in bench.stand_distributions().items() if n != "voltmeter_error"}
        self.setting_rad = stand_u["setting_error"]
        readings = planned_readings(self.plan, model, bench.simulated_block())
        # a chamber's cycle of 37 min, and 0.25 K in two hours
        time_s = readings.time_s
        warmth = 23.0 + 0.15 * np.sin(2 * np.pi * time_s / 2220.0) + 0.25 * time_s / 7200.0
        self.linear: LinearSystem = make_linear(replace(readings, temperature_c=warmth), model, stand_u)
        self.design = ReadingDesign(self.linear, NoiseSize(SIGMA_V, self.setting_rad, 42))

    @property
    def settings(self) -> int:
        apart = {VERIFICATION, *UNORIENTED}
        return sum(isinstance(s, Read) and s.installation not in apart for s in self.plan.steps)

    def score(self, draws: int, seed: int) -> tuple[dict[str, Share], int]:
        """Return the shares of marks over all draws, and the number of possible names of all named effects."""
        candidates = make_candidates(self.linear, SIGMA_V)
        grid = make_noise_grid(self.linear, SIGMA_V, self.setting_rad)
        whitened = Whitened.of(grid, candidates)
        threshold = make_threshold(self.linear, whitened)
        forms = {family: [v for v in candidates.variants if v.family == family] for family in CATALOGUE}
        marks, names = [], 0
        for number in range(draws):
            rng = np.random.default_rng([seed, number])
            family = list(CATALOGUE)[rng.integers(len(CATALOGUE))]
            size = rng.choice([1.0, 3.0])
            response = self._noise(rng)
            if forms[family]:
                form = forms[family][rng.integers(len(forms[family]))]
                columns = candidates.columns[:, list(form.columns)]
                response = response + columns @ (size * rng.standard_normal(columns.shape[1]))
            found = name(whitened, whitened.reduce(response[:, None]), threshold).found
            mark, size = judged(found, family)
            marks.append(mark)
            names += size
        return shares(marks), names

    def row(self, draws: int, seed: int) -> Row:
        """Return the table row of a procedure: number of settings, hours, and counts."""
        of, names = self.score(draws, seed)
        return (
            self.settings, f"{self.plan.expected_duration_s() / 3600.0:.1f}",
            f"{of['named'].part:.2f}", f"{of['in the set'].part:.3f}",
            f"{names / max(of['named'].successes, 1):.2f}", f"{of['alone'].part:.2f}", f"{of['right'].part:.3f}",
        )  # fmt: skip

    def cosine(self, one: Form, other: Form) -> float:
        """Return the cosine of the smallest angle between two forms (1: indistinguishable)."""
        return float(np.cos(subspace_angles(self.design.seen(one), self.design.seen(other)).min()))

    def _noise(self, rng: np.random.Generator) -> np.ndarray:
        linear = self.linear
        setting = self.setting_rad * rng.standard_normal(int(linear.setting.max()) + 1)
        response = SIGMA_V * rng.standard_normal(len(linear))
        response += np.where(linear.setting >= 0, linear.slope, 0.0) * setting[linear.setting]
        return response + linear.random @ rng.standard_normal(linear.random.shape[1])


def main() -> None:
    given = arguments(__doc__, draws=300, seed=1)
    trials = {procedure: Trial(procedure) for procedure in FOR_TIES}
    heads = (
        "procedure", "settings", "hours", "named", "true name in the set", "size of the set", "named alone",
        "of these right",
    )  # fmt: skip
    scored = ((name, *trials[name].row(given.draws, given.seed)) for name in PROCEDURES)
    ties = (
        (tie, *(f"{trials[p].cosine(*map(form_of, forms)):.3f}" for p in FOR_TIES))
        for tie, forms in TIES.items()
    )
    for line in (*markdown(heads, scored), "", *markdown(("tie", *FOR_TIES), ties)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
