"""The functions that `import bench` offers: each result names the bench file and the data that it rests on.

Nothing is printed, and nothing is written unless it is asked for (the thresholds of a diagnosis stay in the user's
cache folder). Functions raise `Refused`, `ReadingsError`, `FileMistakes`, `RecordError` or
`CalibrationError`; each text says why and what to do.
"""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.config.bench_file.file import BenchFile
from bench.readings.csv import read_csv, read_frame
from bench.readings.table import Readings
from bench.services.arguments import BENCH, FLAG, NAME, SOURCE, checked, python_call
from bench.services.bench_selection import bench_of, find_bench_file, origin_beside
from bench.services.bodies import single_bodies, whole_body
from bench.services.calibration import (
    CalibrationResult,
    calibrated,
    calibration_of,
    verification_of,
    verified,
)
from bench.services.confirmation import ConfirmationResult, confirmation_of
from bench.services.diagnosis import Diagnosed, diagnosed, diagnosed_alone
from bench.services.own_effects import knowing_effects_in
from bench.services.requests.evaluation import Calibrate, Confirm, Diagnose, Verify
from bench.services.requests.measuring import DryRunRequest, RunRequest
from bench.services.source import Failed, Request, Source, load_sources, reading
from bench.services.verification import VerdictOptions, VerificationResult

if TYPE_CHECKING:
    import pandas as pd

    from bench.run.folder import Run
    from bench.services.requests.shared import Bench


@checked(bench=NAME)
def load_bench(bench: str | Path) -> BenchFile:
    """Read a bench file, by path or shipped name; numbers in SI, angles in rad. Raises `FileMistakes`."""
    return find_bench_file(str(bench)).file


@checked(readings=SOURCE, bench=BENCH, skip_bad_rows=FLAG)
def read_readings(
    readings: str | Path | pd.DataFrame, *, bench: Bench = None, skip_bad_rows: bool = False
) -> Readings:
    """Read a readings file, or a pandas DataFrame with the same columns (`angle_deg`, `ux_v`, …).

    The bench file says which installations there are. Raises `ReadingsError` with every bad row, unless those are
    to be skipped: `Readings.skipped` lists them then.
    """
    given = str(bench) if isinstance(bench, Path) else bench
    if isinstance(readings, str | Path):
        path = Path(readings)
        taken, _ = bench_of(str(path), None, origin_beside(path), given)
        return read_csv(path, taken.file.installation_models(), skip_bad_rows=skip_bad_rows)
    return read_frame(
        readings, find_bench_file(given).file.installation_models(), skip_bad_rows=skip_bad_rows
    )


def _calibrate(request: Calibrate) -> CalibrationResult:
    """Return the twelve coefficients of U = K a + U0 with their uncertainty, as `bench calibrate` finds them.

    `bench` gives the errors of the stand and local gravity; without it a run is evaluated with the bench file that
    it recorded, all else with that of BENCH_FILE, a readings file with the one that the file beside it names
    (`bench export` writes it), or the shipped paper-stand; `result.bench` says which. `g` is
    local gravity in m/s² in place of the bench file's, `model` a model file with effects beside the paper's terms,
    `effects` files with formulas of effects of the user's own,
    `runs` the folder of runs (BENCH_RUNS, or ./runs). `join_free` lets free positions (F) join by |a| = 1 g,
    `join_verification` the verification points, `nominal_angles` takes the target angles; `prior` is a file of
    `bench fleet prior`: the coefficients expected from units of the block's type.
    """
    with knowing_effects_in(request.effects):
        (source,) = load_sources(reading(request, request.source))
        return calibrated(request, source)


def _verify(request: Verify) -> VerificationResult:
    """Return Δg (in g) at the verification points against the limit (g), as `bench verify` finds it.

    `coefficients` are those of another day: a result, or a file of `bench calibrate --json`; without them those of
    the same readings. `rule` is "simple" (|Δg| within the limit), "guarded" (|Δg| + w, where w is U or
    `guard_band` times U) or "non-binary"; `population` the mean and the standard deviation of Δg over many blocks,
    g, which enter the risks. What is not given of these is the bench file's; a rule that nobody states is the
    non-binary one with 5 % of false acceptance at most. Else as in `calibrate`.
    """
    VerdictOptions.of(request)
    with knowing_effects_in(request.effects):
        (source,) = load_sources(reading(request, request.source))
        return verified(request, source)


calibrate = python_call(Calibrate, _calibrate)
verify = python_call(Verify, _verify)


def _diagnose(request: Diagnose) -> Diagnosed:
    """Return where readings and model disagree, and which effects are missing, as `bench diagnose` finds them.

    A list of sources is one body of readings, on one bench: of `one_block`, or of a block each; where nobody says
    (None), names and readings tell. The result is a `DiagnosisResult`, of free positions alone a
    `FreeDiagnosisResult`, and a `MistakesResult` where mistakes leave too little to fit. With `write=True` all is
    written that `bench diagnose` writes, into `out` where that is given. All else as in `calibrate`.
    """
    return diagnosed_alone(request, whole_body(request))


def _diagnose_each(request: Diagnose) -> list[Diagnosed | Failed]:
    """Return the diagnosis of each source by itself, side by side; a `Failed` for each that could not be.

    The error of a single source is raised. All else as in `diagnose`.
    """
    return diagnosed(request, single_bodies(request))


diagnose = python_call(Diagnose, _diagnose)
diagnose_each = python_call(Diagnose, _diagnose_each)


def _confirm(request: Confirm) -> ConfirmationResult:
    """Return whether new readings confirm a model file that was found in others, as `bench confirm` finds it.

    All else as in `calibrate`.
    """
    (source,) = load_sources(reading(request, request.source))
    return confirmation_of(source)


confirm = python_call(Confirm, _confirm)


@dataclass(frozen=True)
class DryRun:
    """A finished run on simulated instruments: `run` is its record, `source` the readings with the bench.

    The record is deleted with this object, unless it is kept in a folder of runs.
    """

    run: Run
    source: Source
    _folder: object = field(repr=False)

    @property
    def readings(self) -> Readings:
        """The readings, in the order of measurement."""
        return self.source.readings

    @cached_property
    def calibration(self) -> CalibrationResult:
        """The coefficients of these readings. Raises `CalibrationError` where they do not give them."""
        return calibration_of(self.source)

    @cached_property
    def verification(self) -> VerificationResult | None:
        """Δg at the verification points; None where the procedure has none."""
        return verification_of(self.source, self.calibration) if len(self.readings.verification()) else None

    def __repr__(self) -> str:
        """Return the name of the procedure and the result."""
        lines = [f"Dry run {self.run.name}: {len(self.readings)} readings, bench {self.source.taken.words}"]
        if self.verification is not None:
            lines.append(self.verification.verdict())
        return "\n".join(lines)


def _dry_run(request: DryRunRequest) -> DryRun:
    """Run a procedure on simulated instruments over the same drivers and wire, with a virtual clock.

    `seed` gives the random numbers, `model` a model file with effects that the simulated bench has. The record is
    kept in the folder `runs` if one is given. Raises `Refused` with all mistakes of the procedure.
    """
    from bench.run.folder import Run
    from bench.services.execution import carry_out, new_run

    folder = None if request.runs is not None else tempfile.TemporaryDirectory(prefix="bench-dry-run-")
    given = {one.name: getattr(request, one.name) for one in fields(request)}
    new = new_run(RunRequest(**{**given, "runs": folder.name if folder else request.runs}, dry_run=True))
    carry_out(Run(new.folder), new.record(), Console(file=io.StringIO(), quiet=True))
    (source,) = load_sources(Request([str(new.folder)], new.folder.parent))
    return DryRun(Run(new.folder), source, folder)


dry_run = python_call(DryRunRequest, _dry_run)
