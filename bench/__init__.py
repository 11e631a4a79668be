"""The calibration bench for triaxial accelerometer blocks, from Python.

    import bench

    result = bench.calibrate("readings.csv", bench="my-bench.yaml")
    print(result.coefficients["Kxx"].value, result.coefficients["Kxx"].u)
    result.report("report.html")

Readings are a file, a run by name, or a pandas DataFrame with the columns of the file. What is public stands in
`__all__`; it is imported when it is first used, so that `import bench` takes no time.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as `typing` has it: its import would be a while in which Ctrl-C leaves a traceback
if TYPE_CHECKING:
    from typing import Any, Final

    from bench.analysis.calibration import CalibrationError
    from bench.api.budget import BudgetResult, budget
    from bench.api.calibration import CalibrationResult, Coefficient
    from bench.api.chart_sources import chart
    from bench.api.check_block import CheckBlockChart
    from bench.api.confirmation import ConfirmationResult
    from bench.api.diagnosis import DiagnosisResult
    from bench.api.errors import Refused
    from bench.api.face import (
        DryRun,
        calibrate,
        confirm,
        diagnose,
        dry_run,
        learn,
        load_bench,
        read_readings,
        verify,
    )
    from bench.api.free_diagnosis import FreeDiagnosisResult
    from bench.api.learning import LearningResult
    from bench.api.verification import VerificationResult
    from bench.base.forms import FileMistakes
    from bench.files.bench.file import BenchFile
    from bench.readings.csv import ReadingsError
    from bench.readings.table import Readings
    from bench.run.manifest import RecordError

__all__ = [
    "BenchFile",
    "BudgetResult",
    "CalibrationError",
    "CalibrationResult",
    "CheckBlockChart",
    "Coefficient",
    "ConfirmationResult",
    "DiagnosisResult",
    "DryRun",
    "FileMistakes",
    "FreeDiagnosisResult",
    "LearningResult",
    "Readings",
    "ReadingsError",
    "RecordError",
    "Refused",
    "VerificationResult",
    "budget",
    "calibrate",
    "chart",
    "confirm",
    "diagnose",
    "dry_run",
    "learn",
    "load_bench",
    "read_readings",
    "verify",
]

_HOMES: Final = {
    "bench.analysis.calibration": ("CalibrationError",),
    "bench.api.budget": ("BudgetResult", "budget"),
    "bench.api.calibration": ("CalibrationResult", "Coefficient"),
    "bench.api.chart_sources": ("chart",),
    "bench.api.check_block": ("CheckBlockChart",),
    "bench.api.confirmation": ("ConfirmationResult",),
    "bench.api.diagnosis": ("DiagnosisResult",),
    "bench.api.errors": ("Refused",),
    "bench.api.face": (
        "DryRun", "calibrate", "confirm", "diagnose", "dry_run", "learn", "load_bench", "read_readings", "verify",
    ),
    "bench.api.free_diagnosis": ("FreeDiagnosisResult",),
    "bench.api.learning": ("LearningResult",),
    "bench.api.verification": ("VerificationResult",),
    "bench.base.forms": ("FileMistakes",),
    "bench.files.bench.file": ("BenchFile",),
    "bench.readings.csv": ("ReadingsError",),
    "bench.readings.table": ("Readings",),
    "bench.run.record": ("RecordError",),
}  # fmt: skip
"""Where the public names stand."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(home), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
