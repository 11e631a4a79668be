"""The paper's bench and its 54 settings, as the planning of test points sees them."""

from collections.abc import Iterable

import numpy as np

from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import Block, ForwardModel, Mounting
from bench.planning.optimal_design import Goal, Stand, whole_goal
from bench.planning.points import Sites
from bench.planning.requirements import Cost, fitted, settings_of
from bench.validation.paper_bench import U0, K

BENCH = load_bench(find_bench("paper-stand"))
SIZES = {name: d.u for name, d in BENCH.stand_distributions().items()}
STAND = Stand(ForwardModel(BENCH.installation_models()), Block(K, U0), SIZES)
COST = Cost(134.1, 1800.0, 3600.0)
PAPER = fitted(settings_of(load_procedure(find_procedure("paper")).plan))


def sites(labels: Iterable[str] = "12", angles: int = 24, visits: int = 1) -> Sites:
    mounts = [Mounting(v, label) for v in range(1, visits + 1) for label in labels]
    return Sites(STAND, mounts, 2 * np.pi * np.arange(angles) / angles)


def whole(goals: list[Goal]) -> list[Goal]:
    return [*goals, whole_goal(STAND.block, goals)]
