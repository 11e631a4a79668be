"""Compare the paper's 54 settings with chosen ones.

    python -m benchmarks.point_planning

The chosen settings are as many as the paper's, or the fewest of the same uncertainty.
"""

import time
from collections.abc import Sequence

import numpy as np

from bench.base.arrays import Floats
from bench.calibration import CalibrationError
from bench.calibration.budget.coefficients import Setup, make_budget
from bench.calibration.budget.sources import stand_source
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import Distribution, ForwardModel, Mounting
from bench.planning.optimal_design import Goal, Stand, coefficient_goals, vector_goal
from bench.planning.points import ChosenPoints, Sites, Times, best_within, cheapest
from bench.planning.requirements import Setting, conditions_of, fitted, settings_of
from benchmarks.campaign import arguments

ANGLES = 24
COUNTED = Times().cost(50.0, verified=False)


def paper_settings() -> list[Setting]:
    return fitted(settings_of(load_procedure(find_procedure("paper")).expand()))


def by_estimator(stand: Stand, estimator: str, settings: Sequence[Setting]) -> Floats:
    """Return the covariance (12, 12) of the coefficients by an estimator, for known noise."""
    setup = Setup(stand.model, conditions_of(settings), stand.block)
    sources = [stand_source(name, Distribution(u)) for name, u in stand.sizes.items() if u > 0]
    return make_budget(setup, sources, estimator).combined.covariance


def goals_of(stand: Stand, covariance: Floats) -> dict[str, list[Goal]]:
    """Return goals equal to the uncertainties in a covariance: for the whole vector, and for each coefficient."""
    whole = vector_goal(stand.block)
    each = coefficient_goals({"all": 1.0})
    return {
        "error vector at 1 g": [vector_goal(stand.block, 1.0, whole.u(covariance))],
        "each coefficient": [Goal(g.name, g.functionals, g.u(covariance), g.unit) for g in each],
    }


def told(found: ChosenPoints) -> str:
    mounts = ", ".join(str(mount) for mount in found.visits)
    return (
        f"{found.count:4d} settings in {mounts}: {found.worst.ratio(found.covariance):.3f} of what was asked"
    )


def compare(stand: Stand, sites: Sites) -> None:
    settings = paper_settings()
    own = stand.promise(settings, ()).combined
    closed = by_estimator(stand, "closed-form", settings)
    vector = vector_goal(stand.block)
    print(f"  rms error vector at 1 g of the paper's 54 settings: closed form {vector.u(closed) * 1e6:.1f} µg, "
          f"least squares {vector.u(by_estimator(stand, 'least-squares', settings)) * 1e6:.1f} µg, "
          f"gls {vector.u(own) * 1e6:.1f} µg")  # fmt: skip
    for what, goals in goals_of(stand, own).items():
        best = best_within(stand, sites, goals, COUNTED, COUNTED.total_s(len(settings), 2), 2)
        ratio = best.worst.ratio(best.covariance)
        print(f"  {what}: the best {best.count} settings give {ratio:.3f} of the paper's by gls")
    for reference, covariance in (("gls", own), ("the closed form", closed)):
        for what, goals in goals_of(stand, covariance).items():
            begun = time.process_time()
            try:
                text = told(cheapest(stand, sites, goals, COUNTED, 120, 2))
            except CalibrationError as error:
                text = str(error)
            spent = time.process_time() - begun
            print(f"  as the paper's 54 by {reference}, {what}: {text} ({spent:.1f} s)")


def main() -> None:
    arguments(__doc__)
    bench = load_bench(find_bench("paper-stand"))
    model = ForwardModel(bench.installation_models())
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    mounts = [Mounting(1, "1"), Mounting(1, "2")]
    sizes = {name: d.u for name, d in bench.stand_distributions().items()}
    stand = Stand(model, bench.simulated_block(), sizes)
    compare(stand, Sites(stand, mounts, angles))


if __name__ == "__main__":
    main()
