"""fleet: many units on many benches, as the catalogue has them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from bench.cli import printing
from bench.cli.options import JsonOption, OutOption
from bench.services.errors import Refused

if TYPE_CHECKING:
    from rich.console import Console

    from bench.catalogue.values import CoefficientTable, Compared
    from bench.history.equivalence import Measured

GROUP: Final = typer.Typer(
    name="fleet",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Example: bench fleet effects type='block A' simulated=no",
    help="Many units on many benches: is it the bench or the block? Equivalence, priors, drift, CMC.",
)

Query = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="QUERY…", help="Which calibrations: KEY=VALUE, as of 'bench catalogue'; all if none."
    ),
]
CatalogueOption = Annotated[
    str | None,
    typer.Option(
        "--catalogue", metavar="FILE|URL", help="Catalogue (default: TRIAXIAL_BENCH_CATALOGUE, or the own)."
    ),
]


@GROUP.command(epilog="Example: bench fleet effects type='block A' simulated=no --json effects.json")
def effects(query: Query = None, catalogue: CatalogueOption = None, json: JsonOption = None) -> int:
    """Is it the bench or the block: sizes of what units, benches and time bring, and who stands out."""
    from bench.cli import fleet_tables
    from bench.history.bench_or_block import bench_or_block

    printing.check_target(json)
    measured, notes = _measured(query, catalogue)
    found = bench_or_block(measured)
    out = printing.console(json=json)
    fleet_tables.effects(found, out)
    printing.notes_on(out, (*found.notes, *notes))
    out.print(found.answer, style="bold")
    printing.write_json([{**found.to_json(), "notes": [*found.notes, *notes]}], json)
    return 0


@GROUP.command(epilog="Example: bench fleet compare unit='block A 17' after=2026-01-01 --out comparison")
def compare(
    query: Query = None,
    catalogue: CatalogueOption = None,
    reference: Annotated[
        str | None,
        typer.Option(
            "--reference",
            help="weighted-mean, mandel-paule or dersimonian-laird (default: the first where it holds, else the "
            "second).",
        ),
    ] = None,
    json: JsonOption = None,
    out: OutOption = None,
    strict: Annotated[bool, typer.Option("--strict", help="A bench beyond U (k=2) is not accepted.")] = False,
) -> int:
    """Benches against one another on common units: degrees of equivalence, E_n, Birge ratio."""
    from bench.catalogue.values import compared
    from bench.cli import fleet_tables

    printing.check_target(json)
    table = _table(query, catalogue)
    found = compared(table, _method(reference))
    on = printing.console(json=json)
    fleet_tables.compared(found, on)
    printing.notes_on(on, found.notes)
    if found.apart:
        said = ", ".join(
            f"{bench} in {name} (E_n {en:.1f})" for bench, name, en in found.apart[: fleet_tables.MOST_SHOWN]
        )
        on.print(f"beyond U (k=2): {said}", style="bold")
    else:
        on.print("no bench is off by more than U (k=2)", style="bold")
    fleet_tables.together(found, on)
    result = found.to_json()
    if out is not None:
        _write_compared(out, found, result, on)
    printing.write_json([result], json)
    return 1 if strict and found.apart else 0


@GROUP.command(epilog="Example: bench fleet prior type='block A' simulated=no --prior-out block-a.yaml")
def prior(
    query: Query = None,
    catalogue: CatalogueOption = None,
    prior_out: Annotated[
        Path | None, typer.Option("--prior-out", metavar="FILE", help="Where the prior is written (YAML).")
    ] = None,
    json: JsonOption = None,
) -> int:
    """What the units of a type tell of a further one, as a file for 'bench calibrate --prior'."""
    from bench.cli import fleet_tables
    from bench.history.prior import prior_of

    printing.check_target(json)
    measured, notes = _measured(query, catalogue)
    found = prior_of(measured)
    on = printing.console(json=json)
    fleet_tables.prior(found, on)
    printing.notes_on(on, (*found.notes, *notes))
    result = {**found.to_json(), "notes": [*found.notes, *notes]}
    if prior_out is not None:
        import yaml

        from bench.base.files import write_whole

        write_whole(prior_out, yaml.safe_dump(result, sort_keys=False, allow_unicode=True, width=1000))
        printing.written("prior", prior_out, on)
    printing.write_json([result], json)
    return 0


@GROUP.command(epilog="Example: bench fleet drift unit='block A 17' --at 2027-06-01")
def drift(
    query: Query = None,
    catalogue: CatalogueOption = None,
    at: Annotated[
        str | None, typer.Option("--at", metavar="YYYY-MM-DD", help="Foretell the coefficients at this date.")
    ] = None,
    json: JsonOption = None,
) -> int:
    """What a unit's history tells of its drift, and what its coefficients will be."""
    import numpy as np

    from bench.cli import fleet_tables
    from bench.history.drift import unit_drift
    from bench.history.equivalence import STANDARD_GRAVITY

    printing.check_target(json)
    date = None if at is None else _date(at)
    measured, notes = _measured(query, catalogue)
    units = sorted(set(measured.unit.tolist()))
    if len(units) > 1:
        raise Refused(
            f"a drift is of one unit; the question names {len(units)}: add unit=…, such as unit='{units[0]}'"
        )
    benches = sorted(set(measured.bench.tolist()))
    alike = np.sqrt(np.min(measured.meters**2, axis=0)) if len(benches) == 1 else None
    if len(benches) > 1:
        notes = (
            *notes,
            f"measured on {', '.join(benches)}: differences between benches pass for a drift or scatter",
        )
    found = unit_drift(measured.when, measured.vector, measured.covariance, alike)
    on = printing.console(json=json)
    on.print(f"{units[0]}: {found.count} calibrations, {measured.signal}/g of {STANDARD_GRAVITY} m/s²")
    expected = None if date is None else found.predicted(date)
    fleet_tables.drift(found, expected, at, on)
    printing.notes_on(on, notes)
    result = {"unit": units[0], "signal": measured.signal, "per_g_m_s2": STANDARD_GRAVITY, **found.to_json()}
    result["simulated"] = measured.simulated
    result["expected"] = None if expected is None else _expected_json(str(at), *expected)
    printing.write_json([{**result, "notes": list(notes)}], json)
    return 0


@GROUP.command(epilog="Example: bench fleet cmc procedure='*paper.yaml' state=finished simulated=no")
def cmc(
    query: Query = None,
    catalogue: CatalogueOption = None,
    quantile: Annotated[
        float, typer.Option(min=0.01, max=0.99, help="Share of everyday calibrations that reach it.")
    ] = 0.5,
    json: JsonOption = None,
) -> int:
    """The laboratory's calibration and measurement capability, from its history (ILAC-P14)."""
    from bench.cli import fleet_tables
    from bench.history.capability import capability

    printing.check_target(json)
    measured, notes = _measured(query, catalogue)
    found = capability(measured, quantile)
    on = printing.console(json=json)
    fleet_tables.capability(found, on)
    printing.notes_on(on, (*found.notes, *notes))
    printing.write_json([{**found.to_json(), "notes": [*found.notes, *notes]}], json)
    return 0


# --- what is asked ------------------------------------------------------------------------------------


def _table(query: list[str] | None, catalogue: str | None) -> CoefficientTable:
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.values import coefficient_table

    with open_catalogue(catalogue, existing=True) as opened:
        return coefficient_table(opened, query or [])


def _measured(query: list[str] | None, catalogue: str | None) -> tuple[Measured, tuple[str, ...]]:
    from bench.catalogue.values import measured_of

    measured, _, notes = measured_of(_table(query, catalogue))
    return measured, notes


def _method(asked: str | None) -> str | None:
    from bench.history.equivalence import METHODS

    known = {method.lower().replace(" ", "-"): method for method in METHODS}
    if asked is not None and asked not in known:
        raise Refused(f"--reference {asked}: known are {', '.join(known)}")
    return None if asked is None else known[asked]


def _date(text: str) -> Any:
    import numpy as np

    try:
        return np.datetime64(text, "s")
    except ValueError:
        raise Refused(f"--at: expected a date such as 2027-06-01, got {text!r}") from None


def _write_compared(folder: Path, found: Compared, result: dict[str, Any], on: Console) -> None:
    from bench.base.files import to_text, write_whole
    from bench.results.figures import equivalence_figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = equivalence_figure(found.benches, found.found, found.signal)
    for what, name, text in (
        ("result", "fleet-compare.json", to_text(result)),
        ("figure", "equivalence.svg", figure),
    ):
        write_whole(folder / name, text)
        printing.written(what, folder / name, on)


def _expected_json(at: str, value: Any, u: Any) -> dict[str, Any]:
    from bench.model.geometry import COEFFICIENTS

    rows = zip(COEFFICIENTS, value.tolist(), u.tolist(), strict=True)
    return {"at": at, "coefficients": {name: {"value": v, "u": own} for name, v, own in rows}}
