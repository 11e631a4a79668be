"""The calibration bench for triaxial accelerometer blocks, from Python.

    import bench

    result = bench.calibrate("readings.csv", bench="my-bench.yaml")
    print(result.coefficients["Kxx"].value, result.coefficients["Kxx"].u)
    result.report("report.html")

Readings are a file, a run by name, or a pandas DataFrame with the columns of the file. The public names are in
`__all__`; each is imported when it is first used, so that `import bench` is quick.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as `typing` has it: its import would be a while in which Ctrl-C leaves a traceback
if TYPE_CHECKING:
    from typing import Any, Final

    from bench.base.yaml_files import FileMistakes as FileMistakes
    from bench.calibration import CalibrationError as CalibrationError
    from bench.certificate.interlaboratory import kit_evaluate as kit_evaluate
    from bench.certificate.interlaboratory import kit_plan as kit_plan
    from bench.certificate.interlaboratory import kit_seal as kit_seal
    from bench.config.bench_file.file import BenchFile as BenchFile
    from bench.readings.csv import ReadingsError as ReadingsError
    from bench.readings.table import Readings as Readings
    from bench.results.budget import BudgetResult as BudgetResult
    from bench.results.control_chart import CheckBlockChart as CheckBlockChart
    from bench.run.events import RecordError as RecordError
    from bench.services.calibration import CalibrationResult as CalibrationResult
    from bench.services.calibration import Coefficient as Coefficient
    from bench.services.check_block import chart as chart
    from bench.services.compensation import compensate as compensate
    from bench.services.compensation import tumble as tumble
    from bench.services.confirmation import ConfirmationResult as ConfirmationResult
    from bench.services.diagnosis import DiagnosisResult as DiagnosisResult
    from bench.services.diagnosis import FreeDiagnosisResult as FreeDiagnosisResult
    from bench.services.diagnosis import MistakesResult as MistakesResult
    from bench.services.diagnosis import RecordDiagnosisResult as RecordDiagnosisResult
    from bench.services.errors import Refused as Refused
    from bench.services.face import DryRun as DryRun
    from bench.services.face import calibrate as calibrate
    from bench.services.face import confirm as confirm
    from bench.services.face import diagnose as diagnose
    from bench.services.face import diagnose_each as diagnose_each
    from bench.services.face import dry_run as dry_run
    from bench.services.face import load_bench as load_bench
    from bench.services.face import read_readings as read_readings
    from bench.services.face import verify as verify
    from bench.services.history import ComparisonResult as ComparisonResult
    from bench.services.history import LearningResult as LearningResult
    from bench.services.history import compare as compare
    from bench.services.history import learn as learn
    from bench.services.history import monitor as monitor
    from bench.services.planning import budget as budget
    from bench.services.stability import RecordAtRest as RecordAtRest
    from bench.services.stability import RecordCalibrationResult as RecordCalibrationResult
    from bench.services.stability import stability as stability
    from bench.services.verification import VerificationResult as VerificationResult

_HOMES: Final = {
    "bench.calibration": ("CalibrationError",),
    "bench.certificate.interlaboratory": ("kit_evaluate", "kit_plan", "kit_seal"),
    "bench.results.budget": ("BudgetResult",),
    "bench.services.planning": ("budget",),
    "bench.services.calibration": ("CalibrationResult", "Coefficient"),
    "bench.results.control_chart": ("CheckBlockChart",),
    "bench.services.check_block": ("chart",),
    "bench.services.compensation": ("compensate", "tumble"),
    "bench.services.confirmation": ("ConfirmationResult",),
    "bench.services.diagnosis": (
        "DiagnosisResult", "FreeDiagnosisResult", "MistakesResult", "RecordDiagnosisResult",
    ),
    "bench.services.errors": ("Refused",),
    "bench.services.face": (
        "DryRun", "calibrate", "confirm", "diagnose", "diagnose_each", "dry_run", "load_bench",
        "read_readings", "verify",
    ),
    "bench.services.history": ("ComparisonResult", "LearningResult", "compare", "learn", "monitor"),
    "bench.services.stability": ("RecordAtRest", "RecordCalibrationResult", "stability"),
    "bench.services.verification": ("VerificationResult",),
    "bench.base.yaml_files": ("FileMistakes",),
    "bench.config.bench_file.file": ("BenchFile",),
    "bench.readings.csv": ("ReadingsError",),
    "bench.readings.table": ("Readings",),
    "bench.run.events": ("RecordError",),
}  # fmt: skip
"""The public names, by the module in which they stand. The imports above tell a type checker the same."""

__all__ = sorted(name for names in _HOMES.values() for name in names)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(home), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
