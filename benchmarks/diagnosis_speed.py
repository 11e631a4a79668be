"""What a diagnosis costs: CPU seconds of all that `bench diagnose` works out, by its verdict.

    python -m benchmarks.diagnosis_speed --each 17

Cases are those of the blind trial, in the paper's design: nothing hidden, one effect, one that is in no catalogue.
Each is diagnosed twice: as a first design, for which the threshold is simulated, and with that in the cache.
One core. Promised: less than 60 s and less than 1 s.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis import ThresholdCache
from bench.diagnosis.pipeline import diagnose_fully
from bench.model import ForwardModel
from benchmarks.blind_trial.adapter import LOCAL_GRAVITY, STATED_BENCH
from benchmarks.blind_trial.cases import Case, Row, make_case
from benchmarks.campaign import arguments


def main(argv: Sequence[str] | None = None) -> int:
    """Diagnose the cases and print the table; return the exit status."""
    given = arguments(__doc__, argv, seed=5, rho=20.0, each=(17, "cases of each kind"))
    bench = load_bench(find_bench(STATED_BENCH))
    model = ForwardModel(bench.installation_models())
    spent: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        cache = ThresholdCache(Path(folder))

        def cost(case: Case) -> tuple[str, float]:
            begun = time.process_time()
            full = diagnose_fully(
                case.readings, model, bench, LOCAL_GRAVITY, cache, source=case.id, simulated=True
            )
            return full.diagnosis.verdict, time.process_time() - begun

        rows = [Row("null"), Row("single", rho=given.rho), Row("outside", rho=given.rho)]
        for row in rows:
            for index in range(given.each):
                case, _ = make_case(given.seed, row, index)
                _, first = cost(case)
                spent["a first design"].append(first)
                verdict, again = cost(case)
                spent[verdict].append(again)
    print("| verdict | cases | CPU, s: median | largest |\n|---|---|---|---|")
    for verdict, seconds in spent.items():
        print(f"| {verdict} | {len(seconds)} | {np.median(seconds):.2f} | {max(seconds):.2f} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
