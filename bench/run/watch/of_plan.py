"""The early warning of a run: what its plan and its bench make it expect."""

from __future__ import annotations

from itertools import pairwise

from bench.files.bench.file import BenchFile
from bench.model import ForwardModel
from bench.procedure.plan import Plan, Read
from bench.run.watch.early_warning import EarlyWarning
from bench.run.watch.watcher import Watcher


def watcher_of(plan: Plan, bench: BenchFile) -> Watcher:
    """Return who compares each reading of a plan with what the model expects from those before it."""
    reads = [step for step in plan.steps if isinstance(step, Read)]
    following = {
        (read.series, read.installation, read.pass_number, read.point): after.target_rad
        for read, after in pairwise(reads)
        if after.target_rad is not None
        and (read.series, read.installation) == (after.series, after.installation)
    }
    warning = EarlyWarning(
        bench.unit_under_test.scale_factors.values,
        ForwardModel(bench.installation_models()),
        {name: distribution.u for name, distribution in bench.stand_distributions().items()},
        readings=len(reads),
        following=following,
    )
    return Watcher(warning)
