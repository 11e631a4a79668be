"""What a finished run is concluded with: calibration, verification, report, control chart, kept in its folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bench.base.files import to_text, write_whole
from bench.calibration import CalibrationError
from bench.results.control_chart import CheckBlockChart
from bench.run.folder import RESULTS, Run
from bench.run.listening import Interrupts
from bench.services.bench_selection import own_bench
from bench.services.calibration import CalibrationResult, calibration_of, report_page
from bench.services.check_block import chart_of, check_block_runs, is_check_block
from bench.services.early_mistakes import told_in_words
from bench.services.errors import Refused
from bench.services.source import Request, Source, load_sources
from bench.services.until import is_short
from bench.services.verification import NOTHING_ASKED, VerificationResult

_MADE: Final = ("calibrate.json", "verify.json", "report.html", "chart.json")
"""What may be made of a finished run."""


@dataclass(frozen=True)
class Conclusion:
    """The results of a finished run; each is None where there is none.

    `looks` are remarks of the early warning, `short` says that a run ended without its goal. `no_calibration` and
    `no_chart` say why there is none, empty for a run that is not of the check block. `chart_unwritten` is why its
    file could not be written.
    """

    run: Run
    source: Source
    looks: tuple[str, ...]
    short: bool
    calibration: CalibrationResult | None = None
    verification: VerificationResult | None = None
    report: Path | None = None
    no_calibration: str = ""
    chart: CheckBlockChart | None = None
    no_chart: str = ""
    chart_unwritten: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the run reached its goal, and fit, verdict and chart are accepted, as far as there are any."""
        judged = (
            self.calibration and self.calibration.accepted,
            self.verification and self.verification.passed,
        )
        return not self.short and all(
            one is not False for one in (*judged, self.chart and self.chart.accepted)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what `bench run --json` writes: null for a calibration or verdict that there is not."""
        return {
            "run": self.run.name,
            "folder": str(self.run.folder),
            "calibration": self.calibration and self.calibration.to_dict(),
            "verification": self.verification and self.verification.to_dict(),
        }


def make_results(run: Run, interrupts: Interrupts) -> Conclusion:
    """Conclude a run whose bench is safe; `resume` does so again after a signal. Raises `Refused` for one."""
    kept = f"all readings are kept in {run.folder}"
    again = f"stopped before the results were made; {kept}, and 'bench resume {run.name}' makes the results"
    try:
        interrupts.release(again)
        return conclude(run)
    except KeyboardInterrupt:
        raise Refused(again if run.results_missing else f"stopped; {kept} with their results") from None


def conclude(run: Run) -> Conclusion:
    """Calibrate, verify, report and chart a finished run, and write the results into its folder.

    A procedure need not be a calibration: where its readings do not make one, the conclusion says so. Raises
    `Refused` where a result cannot be written.
    """
    (source,) = load_sources(Request([str(run.folder)], run.folder.parent))
    try:
        found = {**_evaluated(source), **charted(run)}
        made = [name for name in _MADE if (run.folder / name).is_file()]
        write_whole(run.folder / RESULTS, to_text({"made": made}))
    except OSError as error:
        raise Refused(
            f"{error.filename}: cannot be written ({error.strerror}); the run is finished and kept: free the disk, "
            f"then 'bench resume {run.name}' makes its results"
        ) from error
    return Conclusion(run, source, tuple(told_in_words(run)), is_short(run), **found)


def _evaluated(source: Source) -> dict[str, Any]:
    """Calibrate, report and verify the readings. Raises `OSError`."""
    try:
        result = calibration_of(source)
    except CalibrationError as reason:
        return {"no_calibration": str(reason)}
    write_whole(source.output("calibrate", ".json"), to_text(result.to_dict()))
    page, verdict = report_page(result, NOTHING_ASKED)
    file = source.output("report", ".html")
    write_whole(file, page)
    if verdict is not None:
        write_whole(source.output("verify", ".json"), to_text(verdict.to_dict()))
    return {"calibration": result, "verification": verdict, "report": file}


def charted(run: Run) -> dict[str, Any]:
    """Put a run of the check block on its chart; of any other run there is nothing to say."""
    bench, path = own_bench(run)
    unit = run.manifest.get("unit_under_test")
    if bench.check_block is None or unit is None or not is_check_block(bench, unit):
        return {}
    runs = check_block_runs(bench, run.folder.parent, simulated=run.simulated)
    try:
        chart = chart_of(runs, bench.check_block, of_bench=path, folder=run.folder.parent)
    except Refused as reason:
        return {"no_chart": str(reason)}
    try:
        write_whole(run.folder / "chart.json", to_text(chart.to_dict()))
    except OSError as error:
        return {
            "chart": chart,
            "chart_unwritten": f"{os.fspath(run.folder / 'chart.json')} ({error.strerror})",
        }
    return {"chart": chart}
