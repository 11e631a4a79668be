"""The result model of each schema name, from which its JSON schema is generated."""

from __future__ import annotations

from importlib import import_module
from typing import Final

from bench.base.result_model import ResultModel

RESULTS: Final = {
    "certificate": "certificate.CertificateResult",
    "certificate-register": "certificate.RegisterResult",
    "certificate-verify": "certificate.VerifyResult",
    "batch": "batch.BatchResult",
    "budget": "budget.BudgetResult",
    "calibrate": "calibration.CalibrateResult",
    "calibrate-record": "record_calibration.RecordCalibrateResult",
    "catalogue-ask": "catalogue.AskResult",
    "catalogue-due": "catalogue.DueResult",
    "catalogue-sync": "catalogue.SyncResult",
    "catalogue-unit": "catalogue.UnitResult",
    "chart": "control_chart.ChartResult",
    "check": "check.CheckResult",
    "coefficients": "bench.exchange.result.CoefficientsResult",
    "compare": "compare.CompareResult",
    "compensate": "compensation.CompensateResult",
    "diagnose": "diagnosis.DiagnoseResult",
    "diagnose-free": "free_diagnosis.FreeDiagnoseResult",
    "diagnose-record": "record_diagnosis.RecordDiagnoseResult",
    "confirm": "confirm.ConfirmResult",
    "failures": "registers.FailuresResult",
    "fleet-cmc": "fleet.CapabilityResult",
    "fleet-compare": "compare.BenchesResult",
    "fleet-drift": "fleet.DriftResult",
    "fleet-effects": "fleet.EffectsResult",
    "fleet-prior": "fleet.PriorResult",
    "kit": "interlaboratory.KitResult",
    "learn": "learning.LearnResult",
    "monitor": "monitor.MonitorResult",
    "commission": "records.CommissionResult",
    "event": "records.EventLine",
    "instruments": "records.InstrumentsResult",
    "runs": "records.RunsResult",
    "show": "records.ShowResult",
    "simulate-ready": "records.ReadyResult",
    "persons": "registers.PersonsResult",
    "plan-points": "planning.PlanPointsResult",
    "report": "verification.ReportResult",
    "require": "planning.RequireResult",
    "source-failed": "parts.FailedPart",
    "stability": "stability.StabilityResult",
    "tumble": "tumble.TumbleResult",
    "validate": "validation.ValidationResult",
    "validate-register": "validation.ValidationRegisterResult",
    "verify": "verification.VerifyResult",
}
"""The model of each result by schema name: module (in `bench.results`, or in full) and class."""


def model_of(name: str) -> type[ResultModel]:
    """Return the model class of a result by its schema name. Raises `KeyError` for an unknown name."""
    module, _, model = RESULTS[name].rpartition(".")
    place = module if module.startswith("bench.") else f"bench.results.{module}"
    found: type[ResultModel] = getattr(import_module(place), model)
    return found
