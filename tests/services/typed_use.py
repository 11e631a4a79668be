"""What a user's type checker must accept; mypy reads it, nothing runs it."""

from typing import Any, assert_type

import bench
from bench.base.arrays import Floats


def use() -> None:
    """Use every public function as a notebook does."""
    stand = assert_type(bench.load_bench("paper-stand"), bench.BenchFile)
    readings = assert_type(bench.read_readings("readings.csv", bench=stand), bench.Readings)
    result = assert_type(bench.calibrate(readings, bench=stand, g=9.81), bench.CalibrationResult)
    assert_type(result.coefficients["Kxx"].value, float)
    assert_type(result.covariance, Floats)
    assert_type(result.to_dict(), dict[str, Any])
    assert_type(bench.verify("unit-17", coefficients=result).passed, bool)
    assert_type(bench.diagnose(["first", "second"]).verdict, str)
    assert_type(bench.chart("runs", bench="paper-stand").accepted, bool)
    assert_type(bench.budget("paper-stand").capable, bool | None)
    assert_type(bench.dry_run("paper", seed=2).calibration, bench.CalibrationResult)
    bench.calibrate("unit-17", 9.81)  # type: ignore[arg-type, call-arg]
