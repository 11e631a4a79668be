"""How large an effect must be to be found, beside the best test that there can be.

    python -m benchmarks.detection_limit [--sets 1000]

For effects of the catalogue with one parameter, of growing size rho (in units of noise, after the twelve
coefficients and the stand errors), the share of simulated runs in which the search finds anything. The
matched filter knows the form of each effect and the noise, and pays for 55 looks: it finds an effect when its
projection exceeds 3.74, which is 1 % false alarms over 55 two-sided looks. The search is given 1 % false
alarms, too, for this comparison; the application has fewer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from bench.diagnosis.evidence import Search, null_responses, total_evidence
from bench.diagnosis.noise_grid import make_noise_grid
from benchmarks.campaign import arguments
from tests.support.diagnosis_bench import NOISE_V, Set, paper_run, set_up
from tests.support.paper_bench import SETTING_U_RAD

LOOKS = 55
ALPHA = 0.01
SIZES = (2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0)
NULLS = 6000


def main() -> None:
    """Print the table."""
    sets = arguments(__doc__, sets=(1000, "simulated runs for each size")).sets
    one = set_up(paper_run(None))
    typical = np.sqrt(np.sum(one.linear.slope**2) / (one.linear.setting.max() + 1))
    ratio = SETTING_U_RAD * typical / NOISE_V
    exact = replace(make_noise_grid(one.linear, NOISE_V, SETTING_U_RAD, (ratio,)), known=True)
    known = Set(one.linear, NOISE_V)
    known.grid = exact
    limit = stats.norm.isf(ALPHA / LOOKS / 2)
    rows = [
        ("matched filter, 55 looks", [float(stats.norm.sf(limit - rho)) for rho in SIZES]),
        ("search, noise known", _power(known, known, ratio, sets)),
        ("search, noise unknown", _power(one, known, ratio, sets)),
    ]
    print(f"{'rho':28}" + "".join(f"{rho:8.1f}" for rho in SIZES) + "   at half power")
    reference = None
    for name, power in rows:
        half = float(np.interp(0.5, power, SIZES))
        reference = reference or half
        print(f"{name:28}" + "".join(f"{p:8.3f}" for p in power) + f"   {half:.2f}  ({half / reference:.3f})")


def _power(judged: Set, known: Set, ratio: float, sets: int) -> list[float]:
    search = Search.beside(judged.whitened, ())
    rng = np.random.default_rng(1)

    def evidence(responses: np.ndarray) -> np.ndarray:
        return total_evidence(search.score(judged.whitened.reduce(responses)), judged.whitened)

    nulls = evidence(null_responses(judged.linear, NOISE_V, np.full(NULLS, ratio), rng))
    limit = float(np.quantile(nulls, 1 - ALPHA))
    shapes = _signatures(known)
    power = []
    for rho in SIZES:
        responses = null_responses(judged.linear, NOISE_V, np.full(sets, ratio), rng)
        responses += rho * shapes[:, rng.integers(shapes.shape[1], size=sets)]
        power.append(float(np.mean(evidence(responses) > limit)))
    return power


def _signatures(known: Set) -> np.ndarray:
    """Return effects with one number, scaled to rho = 1: one column each."""
    grid = known.whitened.grid
    kept = []
    for variant in known.candidates.variants:
        if variant.named and len(variant.columns) == 1:
            column = known.candidates.columns[:, variant.columns[0]]
            seen = np.linalg.norm(grid.white[0] @ column) / grid.sigma
            if seen > 0.05:
                kept.append(column / seen)
    return np.stack(kept, axis=1)


if __name__ == "__main__":
    main()
