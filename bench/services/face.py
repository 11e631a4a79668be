"""The functions that `import bench` offers; each result names its bench file and data.

Functions print nothing. They write files only if asked, except for thresholds of a diagnosis, which are cached in
the user's cache folder. They raise `Refused`, `ReadingsError`, `FileMistakes`, `RecordError` or
`CalibrationError`; each message states the reason and the remedy.
"""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, cast

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
    """Read a bench file, by path or shipped name; numbers are in SI units, angles in rad. Raises `FileMistakes`."""
    return find_bench_file(str(bench)).file


@checked(readings=SOURCE, bench=BENCH, skip_bad_rows=FLAG)
def read_readings(
    readings: str | Path | pd.DataFrame, *, bench: Bench = None, skip_bad_rows: bool = False
) -> Readings:
    """Read a readings file, or a pandas DataFrame with the same columns (`angle_deg`, `ux_v`, …).

    The bench file states the installations. Raises `ReadingsError` with every bad row. With `skip_bad_rows`,
    bad rows are left out and listed in `Readings.skipped`.
    """
    if isinstance(readings, str | Path):
        path = Path(readings)
        taken, _ = bench_of(str(path), None, origin_beside(path), bench)
        return read_csv(path, taken.file.installation_models(), skip_bad_rows=skip_bad_rows)
    return read_frame(
        readings, find_bench_file(bench).file.installation_models(), skip_bad_rows=skip_bad_rows
    )


def _calibrate(request: Calibrate) -> CalibrationResult:
    """Return the twelve coefficients of U = K a + U0 with their uncertainty, as `bench calibrate` computes them.

    `bench` is the bench file, which states the errors of the stand and local gravity. Without it, a run is
    evaluated with the bench file that it recorded. Other readings are evaluated with the file in BENCH_FILE, else
    with the one that the origin file beside them names (`bench export` writes it), else with the shipped
    paper-stand. `result.bench` names the file used.

    `g` is local gravity in m/s² in place of the bench file's. `model` is a model file with effects beside the
    paper's terms, `effects` are files with formulas of the user's own effects. `runs` is the folder of runs
    (default: BENCH_RUNS, else ./runs). `join_free` adds the free positions (F) to the fit by |a| = 1 g,
    `join_verification` the verification points. `nominal_angles` uses the target angles in place of those read
    back. `prior` is a file of `bench fleet prior` with the coefficients expected of units of the block's type.
    A record at a known input gives a `RecordCalibrationResult`: gain and offset of its meters.
    """
    with knowing_effects_in(request.effects):
        (source,) = load_sources(reading(request, request.source))
        # of a record it is another class, which the promised type leaves out
        return cast("CalibrationResult", calibrated(request, source))


def _verify(request: Verify) -> VerificationResult:
    """Return Δg (in g) at the verification points and the verdict against the limit (g), as `bench verify` does.

    `coefficients` are the result of an earlier calibration, or its file (`bench calibrate --json`); without
    them they are estimated from the same readings. `rule` is "simple" (|Δg| within the limit), "guarded"
    (|Δg| + w within the limit, where w is U or `guard_band` times U) or "non-binary". `population` is the
    mean and the standard deviation of Δg over many blocks, in g, which enter the risks. Options left out are
    as stated by the run or its bench file; if neither states a rule, it is the non-binary one with at most 5
    % false acceptance. The other parameters are those of `calibrate`.
    """
    VerdictOptions.of(request)
    with knowing_effects_in(request.effects):
        (source,) = load_sources(reading(request, request.source))
        return verified(request, source)


calibrate = python_call(Calibrate, _calibrate)
verify = python_call(Verify, _verify)


def _diagnose(request: Diagnose) -> Diagnosed:
    """Return where readings and model disagree and which effects are missing, as `bench diagnose` reports them.

    A list of sources is diagnosed as one body of readings from one bench. `one_block` is True for readings of one
    block, False for a different block in each source; None leaves the decision to the names of the blocks, then
    to the readings. The result is a `DiagnosisResult`, for free positions alone a `FreeDiagnosisResult`, and a
    `MistakesResult` if the readings free of mistakes are too few to fit. `write=True` writes all files of `bench
    diagnose`, into the folder `out` if given. The other parameters are those of `calibrate`.
    """
    return diagnosed_alone(request, whole_body(request))


def _diagnose_each(request: Diagnose) -> list[Diagnosed | Failed]:
    """Return a diagnosis of each source by itself, computed in parallel; a `Failed` for a source that fails.

    If there is only one source, its error is raised. The other parameters are those of `diagnose`.
    """
    return diagnosed(request, single_bodies(request))


diagnose = python_call(Diagnose, _diagnose)
diagnose_each = python_call(Diagnose, _diagnose_each)


def _confirm(request: Confirm) -> ConfirmationResult:
    """Return whether new readings confirm a model file that was found in other readings, as `bench confirm` does.

    The other parameters are those of `calibrate`.
    """
    (source,) = load_sources(reading(request, request.source))
    return confirmation_of(source)


confirm = python_call(Confirm, _confirm)


@dataclass(frozen=True)
class DryRun:
    """A finished run on simulated instruments: `run` is its record, `source` its readings and bench.

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
        """The calibration from these readings. Raises `CalibrationError` if there is none."""
        return calibration_of(self.source)

    @cached_property
    def verification(self) -> VerificationResult | None:
        """The verification by these readings; None if the procedure has no verification points."""
        return verification_of(self.source, self.calibration) if len(self.readings.verification()) else None

    def __repr__(self) -> str:
        """Return the name of the procedure and the result."""
        lines = [f"Dry run {self.run.name}: {len(self.readings)} readings, bench {self.source.taken.words}"]
        if self.verification is not None:
            lines.append(self.verification.verdict())
        return "\n".join(lines)


def _dry_run(request: DryRunRequest) -> DryRun:
    """Run a procedure on simulated instruments, through the real drivers and message protocol, in virtual time.

    `seed` is the seed of the random numbers, `model` a model file with effects that the simulated bench has. The
    record is kept in the folder `runs` if that is given. Raises `Refused` with all mistakes of the procedure.
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
