"""fleet: many units on many benches, from the catalogue."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.base.languages import message
from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, command, group
from bench.services.errors import Refused
from bench.services.requests.evaluation import Capability, CompareBenches, DriftOfUnit, OfFleet

if TYPE_CHECKING:
    from bench.catalogue.values import CoefficientTable
    from bench.history.measured import ComparedCalibrations

GROUP: Final = group("fleet", "bench fleet effects type='block A' simulated=no")


@command("bench fleet effects type='block A' simulated=no --json effects.json", to=GROUP)
def effects(request: OfFleet, json: JsonOption = None) -> int:
    """Estimate the variation between units, between benches and over time; name outliers."""
    from bench.history.bench_or_block import bench_or_block
    from bench.results.fleet import effects_result, print_effects

    measured, notes = _measured(request)
    result = effects_result(bench_or_block(measured), notes)
    return printing.told(result, json, partial(print_effects, result))


@command("bench fleet compare unit='block A 17' after=2026-01-01 --out comparison", to=GROUP)
def compare(
    request: CompareBenches,
    json: JsonOption = None,
    out: OutOption = None,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Reject a bench that is off in the joint test of the nine numbers."),
    ] = False,
) -> int:
    """Compare benches on common units: degrees of equivalence, E_n, Birge ratio."""
    from bench.base.files import to_text
    from bench.catalogue.values import compared
    from bench.results.compare import benches_result, equivalence_figure, print_benches

    found = compared(_table(request), _method(request.reference))
    result = benches_result(found)
    files = (
        ()
        if out is None
        else (
            ("result", out / "fleet-compare.json", to_text(result.to_dict())),
            (message("figure", "heading"), out / "equivalence.svg", equivalence_figure(found)),
        )
    )
    printing.told(result, json, partial(print_benches, result), files)
    return 1 if strict and result.off else 0


@command("bench fleet prior type='block A' simulated=no --prior-out block-a.yaml", to=GROUP)
def prior(
    request: OfFleet,
    prior_out: Annotated[
        Path | None, typer.Option("--prior-out", metavar="FILE", help="Where the prior is written (YAML).")
    ] = None,
    json: JsonOption = None,
) -> int:
    """Estimate a prior for a new unit from units of its type, for 'bench calibrate --prior'."""
    from bench.history.prior import prior_of
    from bench.results.fleet import print_prior, prior_result

    measured, notes = _measured(request)
    result, files = prior_result(prior_of(measured), notes), []
    if prior_out is not None:
        import yaml

        text = yaml.safe_dump(result.to_dict(), sort_keys=False, allow_unicode=True, width=1000)
        files.append(("prior", prior_out, text))
    return printing.told(result, json, partial(print_prior, result), files)


@command("bench fleet drift unit='block A 17' --at 2027-06-01", to=GROUP)
def drift(request: DriftOfUnit, json: JsonOption = None) -> int:
    """Estimate the drift of a unit from its history; predict its coefficients."""
    from bench.history.drift import drift_of_unit
    from bench.results.fleet import drift_result, print_drift

    measured, notes = _measured(request)
    result = drift_result(drift_of_unit(measured), request.at, notes)
    return printing.told(result, json, partial(print_drift, result))


@command("bench fleet cmc procedure='*paper.yaml' state=finished simulated=no", to=GROUP)
def cmc(request: Capability, json: JsonOption = None) -> int:
    """Estimate the laboratory's calibration and measurement capability from its history (ILAC-P14)."""
    from bench.history.capability import capability
    from bench.results.fleet import capability_result, print_capability

    measured, notes = _measured(request)
    result = capability_result(capability(measured, request.quantile), notes)
    return printing.told(result, json, partial(print_capability, result))


def _table(request: OfFleet) -> CoefficientTable:
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.values import coefficient_table

    with open_catalogue(request.catalogue, existing=True) as opened:
        return coefficient_table(opened, request.query or [])


def _measured(request: OfFleet) -> tuple[ComparedCalibrations, tuple[str, ...]]:
    from bench.catalogue.values import measured_of

    measured, _, notes = measured_of(_table(request))
    return measured, notes


def _method(asked: str | None) -> str | None:
    from bench.history.equivalence import METHODS

    known = {method.lower().replace(" ", "-"): method for method in METHODS}
    if asked is not None and asked not in known:
        raise Refused(f"--reference {asked}: choose from {', '.join(known)}")
    return None if asked is None else known[asked]
