"""JSON of a calibration and of a verification that were made without a source."""

from typing import Any

from bench.calibration import Calibration
from bench.calibration.verification import Verification
from bench.results.calibration import calibrate_result
from bench.results.verification import VerdictPart, verdict_members


def calibration_json(found: Calibration) -> dict[str, Any]:
    """Return what `bench calibrate --json` writes for a calibration."""
    of_source = {"source": "readings", "made_at": None, "unit_under_test": None, "simulated": False}
    return calibrate_result(found, **of_source, meters=[], notes=[], skipped_rows=[]).to_dict()


def verification_json(found: Verification) -> dict[str, Any]:
    """Return what `bench verify --json` writes for a verification."""
    return VerdictPart.from_object(found, **verdict_members(found)).to_dict()
