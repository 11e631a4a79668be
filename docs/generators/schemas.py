"""The JSON schemas of results (draft 2020-12), made from their models."""

from __future__ import annotations

import ast
import inspect
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from bench.base.result_model import ResultModel

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"

RESULTS: Final = {
    "certificate": "certificate.CertificateResult",
    "certificate-register": "certificate.RegisterResult",
    "certificate-verify": "certificate.VerifyResult",
    "batch": "batch.BatchResult",
    "budget": "budget.BudgetResult",
    "calibrate": "calibration.CalibrateResult",
    "calibrate-record": "known_input.RecordCalibrateResult",
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
    "diagnose-record": "known_input.RecordDiagnoseResult",
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
    "event": "docs.generators.events.EventLine",
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
    "tumble": "compensation.TumbleResult",
    "validate": "registers.ValidationResult",
    "validate-register": "registers.ValidationRegisterResult",
    "verify": "verification.VerifyResult",
}
"""The model of each result by schema name: module (in `bench.results`, or in full) and class."""


def schema_of(name: str) -> dict[str, Any]:
    """Return the JSON schema of a result by its name. Raises `KeyError` for an unknown name."""
    module, _, model = RESULTS[name].rpartition(".")
    place = module if "." in module else f"bench.results.{module}"
    kind: type[ResultModel] = getattr(import_module(place), model)
    schema = kind.model_json_schema(by_alias=True, schema_generator=_Described)
    return {
        "$schema": DIALECT,
        "$id": f"urn:triaxial-bench:schema:{name}",
        **schema,
        "description": " ".join(schema["description"].split()),
        "title": f"Result of bench {name}",
    }


class _Described(GenerateJsonSchema):
    """A generator of schemas that takes the text below a member for its description."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Return the schema of a model, with the texts below its members and below those of its base classes."""
        found, model = super().model_schema(schema), schema["cls"]
        for kind in (
            model.__mro__[: model.__mro__.index(ResultModel)] if issubclass(model, ResultModel) else ()
        ):
            for name, text in _texts_below(kind).items():
                found["properties"][model.model_fields[name].alias or name]["description"] = text
        return found


def _texts_below(model: type) -> dict[str, str]:
    """Return the text below each member in the source of a model."""
    found = {}
    for member, below in pairwise(_classes(inspect.getfile(model))[model.__name__].body):
        match member, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = " ".join(text.split())
    return found


@cache
def _classes(file: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module by name; `inspect.getsource` would parse the module for each."""
    nodes = ast.walk(ast.parse(Path(file).read_text(encoding="utf-8")))
    return {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}
