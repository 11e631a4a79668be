"""Which model each result is of, so that its JSON schema can be made."""

from __future__ import annotations

from importlib import import_module
from typing import Final

from bench.base.result_model import ResultModel

RESULTS: Final = {
    "budget": "budget.BudgetResult",
    "calibrate": "calibration.CalibrateResult",
    "check": "check.CheckResult",
    "batch": "batch.BatchResult",
    "catalogue-ask": "catalogue.AskResult",
    "catalogue-due": "catalogue.DueResult",
    "catalogue-sync": "catalogue.SyncResult",
    "catalogue-unit": "catalogue.UnitResult",
    "confirm": "confirm.ConfirmResult",
    "plan-points": "planning.PlanPointsResult",
    "report": "verification.ReportResult",
    "require": "planning.RequireResult",
    "source-failed": "parts.FailedPart",
    "verify": "verification.VerifyResult",
}
"""The model of each result, as module of this room and class, by the name of its schema."""


def model_of(name: str) -> type[ResultModel]:
    """Return the model of a result by name."""
    module, _, model = RESULTS[name].partition(".")
    found: type[ResultModel] = getattr(import_module(f"bench.results.{module}"), model)
    return found
