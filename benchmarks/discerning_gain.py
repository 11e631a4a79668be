"""What the procedure `discerning` gains against `paper` and `calibration`: how many effects are named, and alone.

Usage: python -m benchmarks.discerning_gain [--draws 300] [--seed 1]

The readings are those that a procedure would give, made linear; an effect of the catalogue is drawn (every family
alike, one of its forms, normal sizes of one or three times what is plausible), with the noise of the bench,
and the naming of `bench diagnose` is asked. The effects are the catalogue's own forms, which flatters the naming:
the table compares procedures, and does not say how well effects of a real bench are named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

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
from benchmarks.campaign import arguments

PROCEDURES = ("paper", "calibration", "discerning")
FOR_TIES = (*PROCEDURES, "turn-12", "turn-24", "remount-90")
SIGMA_V = 15e-6
"""Noise of a reading."""


def part(family: str, parameter: str, channel: int | None = None, *mounts: str, **shape: float) -> EffectPart:
    return EffectPart(family, parameter, tuple(shape.items()), mounts, channel)


def everywhere(family: str, parameter: str, channels: tuple[int, ...] = (0, 1, 2)) -> Form:
    return tuple(part(family, parameter, channel) for channel in channels)


TIES: dict[str, tuple[Form, Form]] = {
    "backlash – zero_offset": ((part("backlash", "play"),), (part("zero_offset", "angle"),)),
    "axis_wobble (once, sine) – zero_offset": (
        (part("axis_wobble", "sine", harmonic=1.0),),
        (part("zero_offset", "angle"),),
    ),
    "mounting_error 1 – mounting_offset 2": (
        (part("mounting_error", "angle", None, "1"),),
        (part("mounting_offset", "angle", None, "2"),),
    ),
    "turn_on_shift z – bracket_tilt 2": (
        (part("turn_on_shift", "step", 2, "2"),),
        (part("bracket_tilt", "angle", None, "2"),),
    ),
    "voltmeter_drift – bias_drift xyz": (
        (part("voltmeter_drift", "rate"),),
        everywhere("bias_drift", "rate"),
    ),
    "voltmeter_nonlinearity (square) – quadratic_nonlinearity xyz": (
        (part("voltmeter_nonlinearity", "q2"),),
        everywhere("quadratic_nonlinearity", "K2"),
    ),
    "bias_drift y – turn_on_shift y": (
        (part("bias_drift", "rate", 1),),
        (part("turn_on_shift", "step", 1, "2"),),
    ),
    "cubic_nonlinearity – odd_quadratic_nonlinearity (y)": (
        (part("cubic_nonlinearity", "K3", 1),),
        (part("odd_quadratic_nonlinearity", "Koq", 1),),
    ),
    "quadratic_nonlinearity – scale_asymmetry (y)": (
        (part("quadratic_nonlinearity", "K2", 1),),
        (part("scale_asymmetry", "Kabs", 1),),
    ),
    "head_ellipticity (sine) – cubic_nonlinearity xyz": (
        (part("head_ellipticity", "sine"),),
        everywhere("cubic_nonlinearity", "K3"),
    ),
    "axis_wobble (twice, sine) – cross_coupling yz": (
        (part("axis_wobble", "sine", harmonic=2.0),),
        everywhere("cross_coupling", "Kpo", (1, 2)),
    ),
    "channel_crosstalk – cross_coupling, all terms": (
        (part("channel_crosstalk", "fraction"),),
        tuple(
            part("cross_coupling", p.name, c)
            for p in CATALOGUE["cross_coupling"].parameters
            for c in (0, 1, 2)
        ),
    ),
}


@dataclass
class Score:
    """Counts over the draws."""

    draws: int = 0
    named: int = 0
    in_set: int = 0
    alone: int = 0
    alone_right: int = 0
    set_size: int = 0

    def add(self, found: tuple[FoundEffect, ...], truth: str) -> None:
        self.draws += 1
        of_catalogue = [f for f in found if f.variant.named]
        if not of_catalogue or len(of_catalogue) < len(found):
            return
        sets = [{f.variant.family, *f.ties} for f in of_catalogue]
        self.named += 1
        self.in_set += any(truth in names for names in sets)
        self.set_size += len(sets[0])
        if len(sets) == 1 and len(sets[0]) == 1:
            self.alone += 1
            self.alone_right += truth in sets[0]


class Trial:
    """A procedure on the paper's bench, and what the naming makes of effects in its readings."""

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

    def score(self, draws: int, seed: int) -> Score:
        candidates = make_candidates(self.linear, SIGMA_V)
        grid = make_noise_grid(self.linear, SIGMA_V, self.setting_rad)
        whitened = Whitened.of(grid, candidates)
        threshold = make_threshold(self.linear, whitened)
        forms = {family: [v for v in candidates.variants if v.family == family] for family in CATALOGUE}
        score = Score()
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
            score.add(found, family)
        return score

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
        "procedure", "settings", "hours", "named", "true name in the set", "size of the set",
        "named alone",
    )  # fmt: skip
    print(f"| {' | '.join(heads)} | of these right |")
    print(f"|{'---|' * (len(heads) + 1)}")
    for procedure in PROCEDURES:
        trial = trials[procedure]
        s = trial.score(given.draws, given.seed)
        hours = trial.plan.expected_duration_s() / 3600.0
        told = (
            f"{s.named / s.draws:.2f} | {s.in_set / max(s.named, 1):.3f} | {s.set_size / max(s.named, 1):.2f}"
        )
        alone = f"{s.alone / s.draws:.2f} | {s.alone_right / max(s.alone, 1):.3f}"
        print(f"| {procedure} | {trial.settings} | {hours:.1f} | {told} | {alone} |")
    print()
    print(f"| tie | {' | '.join(FOR_TIES)} |")
    print(f"|---|{'---|' * len(FOR_TIES)}")
    for tie, (one, other) in TIES.items():
        cosines = [f"{trials[p].design.cosine(one, other):.3f}" for p in FOR_TIES]
        print(f"| {tie} | {' | '.join(cosines)} |")


if __name__ == "__main__":
    main()
