"""What many runs taken together cost: a diagnosis of so many runs of the blind trial as one body of data.

In each hides the same effect of rho 2.3, which no run shows by itself; of one block, or of a block each. CPU time
and peak of memory of a process of its own, with its start and the page, the threshold of the design simulated anew;
the ratio is to one run, diagnosed in the same way. The limits for twenty are a minute and 1 GB:

    python -m benchmarks.many_runs --runs 1 5 20
"""

from __future__ import annotations

from typing import Final

from benchmarks.campaign import arguments, cost_of

LIMIT_S: Final = 60.0
LIMIT_MB: Final = 1000.0
RHO: Final = 2.3
SEED: Final = 1
G_M_S2: Final = 9.81


def diagnosed(runs: int, blocks: bool) -> str:
    """Return the verdict of a diagnosis in this very process."""
    from bench.config.bench_file.file import load_bench
    from bench.config.shipped import find_bench
    from bench.diagnosis import ThresholdCache
    from bench.diagnosis.pipeline import diagnose_fully
    from bench.model import ForwardModel
    from bench.results.diagnosis_page import render_diagnosis
    from bench.results.diagnosis_words import NO_FILES
    from benchmarks.blind_trial.cases import Row, make_case

    case, _ = make_case(SEED, Row("single", rho=RHO, runs=runs, blocks=blocks), 0)
    bench = load_bench(find_bench("paper-stand"))
    model = ForwardModel(bench.installation_models())
    full = diagnose_fully(
        case.readings, model, bench, G_M_S2, ThresholdCache(None), source="many", simulated=False,
        stated=False,
    )  # fmt: skip
    render_diagnosis(full, NO_FILES, "many", bench.verification_limit_g, {"model": model.name})
    return full.diagnosis.verdict


def main() -> int:
    """Print a table; return 1 where twenty runs or fewer take more than the limits."""
    given = arguments(__doc__, runs=[1, 5, 20])
    over = False
    print("runs  blocks     CPU / s   ratio   peak / MB   ratio   verdict")
    for blocks in (False, True):
        first: tuple[float, float] | None = None
        for runs in given.runs:
            verdict, seconds, _, megabytes = cost_of(diagnosed, runs, blocks)
            first = first or (seconds, megabytes)
            over = over or (runs <= 20 and (seconds > LIMIT_S or megabytes > LIMIT_MB))
            of = "a block each" if blocks else "one block"
            times, larger = seconds / first[0], megabytes / first[1]
            print(
                f"{runs:4}  {of:12} {seconds:6.1f}  {times:5.1f}  {megabytes:9.0f}  {larger:6.1f}   {verdict}",
                flush=True,
            )
    return int(over)


if __name__ == "__main__":
    raise SystemExit(main())
