"""catalogue: many run folders in a database, and what it answers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from bench.cli import printing
from bench.cli.options import JsonOption
from bench.services.errors import Refused

if TYPE_CHECKING:
    from bench.catalogue.answers import Answer

GROUP: Final = typer.Typer(
    name="catalogue",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Example: bench catalogue sync runs && bench catalogue ask meter=MY53200001 after=2026-05-03 --of units",
    help="Many run folders in a database: what was measured with what, a unit's history, when it is due.",
)

ON_SCREEN: Final = 40
MOST_DAYS: Final = 36_525

_SHOWN: Final = {
    "runs": ("name", "created", "unit", "bench", "state", "verdict", "diagnosis", "problem"),
    "coefficients": ("name", "created", "unit", "bench", "Kxx", "Kyy", "Kzz", "U0x", "U0y", "U0z"),
}
"""Columns on the screen, where they are not all; CSV, Parquet and JSON have all."""

CatalogueOption = Annotated[
    str | None,
    typer.Option(
        "--catalogue",
        metavar="FILE|URL",
        envvar="TRIAXIAL_BENCH_CATALOGUE",
        help="The catalogue: a file, or postgresql://USER@HOST/NAME (default: in the user's cache folder).",
    ),
]
QueryArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="[KEY=VALUE…]", help="What has to hold; 'bench catalogue keys' lists the keys."),
]


@GROUP.command(epilog="Example: bench catalogue sync runs /data/bench-2/runs")
def sync(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR…", help="Folders with run folders, at any depth.")
    ],
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Read every event of each record, not only the hashes of its lines."),
    ] = False,
    due: Annotated[
        bool,
        typer.Option(
            "--due", help="Then reckon when the units of what changed are due, so that 'due' answers at once."
        ),
    ] = False,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
) -> int:
    """Take what is new or changed in run folders into the catalogue; mark what is gone."""
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.sync import sync as synced
    from bench.catalogue.unit import due_units

    printing.check_target(json)
    on = printing.console(json=json)
    with open_catalogue(catalogue) as opened:
        done = synced(opened, folders, whole=verify)
        for path, reason in sorted(done.problems.items()):
            on.print(f"{path}: {reason}")
        bad = f", {len(done.problems)} with a problem" if done.problems else ""
        counts = (
            f"{done.added} new, {done.changed} changed, {done.moved} moved, {done.unchanged} as they were, "
            f"{done.vanished} gone{bad}"
        )
        on.print(f"{opened.where}: {counts}", style="bold")
        printing.write_json([{"catalogue": opened.where, **done.to_json()}], json)
        if due:
            due_units(opened, [])
    return 0


@GROUP.command(
    epilog="Example: bench catalogue ask meter=MY53200001 after=2026-05-03 --of units --csv units.csv"
)
def ask(
    query: QueryArgument = None,
    of: Annotated[
        str,
        typer.Option(
            "--of",
            metavar="WHAT",
            help="runs, coefficients, units, benches, operators, instruments, certificates, issued or folders.",
        ),
    ] = "runs",
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write all columns and rows as CSV.")
    ] = None,
    parquet: Annotated[
        Path | None, typer.Option("--parquet", metavar="FILE", help="Write them as Parquet.")
    ] = None,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
) -> int:
    """Which runs, units, benches, instruments or certificates a question names."""
    from bench.base.files import write_whole
    from bench.catalogue.answers import answer
    from bench.catalogue.store import open_catalogue

    printing.check_target(json)
    asked = query or []
    with open_catalogue(catalogue, existing=True) as opened:
        found = answer(opened, asked, of)
    on = printing.console(json=json)
    if csv is not None:
        write_whole(csv, found.to_csv())
        printing.written(of, csv, on)
    if parquet is not None:
        found.write_parquet(parquet)
        printing.written(of, parquet, on)
    if json != "-":
        _print(found, of, on)
    printing.write_json(
        [{"query": list(asked), "of": of, "count": len(found), "rows": found.to_json()}], json
    )
    return 0


LimitOption = Annotated[
    float | None,
    typer.Option(
        "--limit", metavar="G", help="Error allowed, in g at 1 g (default: its last verification's)."
    ),
]
IntervalOption = Annotated[
    float | None,
    typer.Option("--interval", metavar="DAYS", help="Counts where a history is too short (default: 365)."),
]


@GROUP.command(epilog="Example: bench catalogue unit 17-042 --page unit.html")
def unit(
    name: Annotated[str, typer.Argument(metavar="UNIT", help="Serial number, or type and serial number.")],
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="Write its page (HTML).")
    ] = None,
    limit: LimitOption = None,
    interval: IntervalOption = None,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
) -> int:
    """One unit: its coefficients over time, its runs, when it is due."""
    from bench.base.files import write_whole
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import unit_history

    printing.check_target(json)
    with open_catalogue(catalogue, existing=True) as opened:
        found = unit_history(opened, name, limit_g=_positive("--limit", limit), interval_days=_days(interval))
    told = found.to_json()
    on = printing.console(json=json)
    if json != "-":
        _print_unit(told, on)
    if page is not None:
        from bench.results.unit import render_unit

        write_whole(page, render_unit(told))
        printing.written("page", page, on)
    printing.write_json([told], json)
    return 0


@GROUP.command(epilog="Example: bench catalogue due bench=stand-2 --before 2027-01-01")
def due(
    query: QueryArgument = None,
    before: Annotated[
        str | None, typer.Option("--before", metavar="YYYY-MM-DD", help="Those that are due before that day.")
    ] = None,
    limit: LimitOption = None,
    interval: IntervalOption = None,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
) -> int:
    """When units are due, by their drift; the first first."""
    from bench.catalogue.questions import moment
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import due_units

    printing.check_target(json)
    try:
        until = moment(before).date().isoformat() if before else None
    except ValueError as error:
        raise Refused(f"--before {before}: {error}") from None
    with open_catalogue(catalogue, existing=True) as opened:
        found, odd = due_units(
            opened, query or [], limit_g=_positive("--limit", limit), interval_days=_days(interval)
        )
    told = [row for row in found if until is None or row["due"] < until]
    on = printing.console(json=json)
    if json != "-":
        _print_due(told, on)
        printing.notes_on(on, [f"{name}: {why}" for name, why in odd.items()])
    printing.write_json([{"query": list(query or []), "units": told, "not_known": odd}], json)
    return 0


@GROUP.command(epilog="Example: bench catalogue keys")
def keys() -> int:
    """List the keys of questions and what they mean."""
    from bench.catalogue.questions import keys_in_words

    out = printing.console()
    table = printing.table("key", "what it asks for")
    for name, meaning in keys_in_words():
        table.add_row(name, meaning)
    out.print(table)
    return 0


def _print(found: Answer, of: str, on: Any) -> None:
    """Print the first rows, with the columns that a screen has room for."""
    names = [name for name in _SHOWN.get(of, found.columns) if name in found.columns]
    places = [found.columns.index(name) for name in names]
    table = printing.table(*(name.replace("_", " ") for name in names))
    for row in found.rows[:ON_SCREEN]:
        table.add_row(*(_cell(row[place]) for place in places))
    if len(found):
        on.print(table)
    more = len(found) - ON_SCREEN
    rest = f"; {more} more are not shown: --csv FILE has all" if more > 0 else ""
    on.print(f"{len(found)} {of}{rest}", style="bold")


def _cell(value: Any) -> str:
    from datetime import datetime

    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, datetime):
        return f"{value:%Y-%m-%d %H:%M}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _positive(option: str, value: float | None) -> float | None:
    if value is not None and not value > 0.0:
        raise Refused(f"{option} {value:g}: expected a number above zero")
    return value


def _days(interval: float | None) -> float | None:
    days = _positive("--interval", interval)
    if days is not None and days > MOST_DAYS:
        raise Refused(f"--interval {days:g}: expected at most {MOST_DAYS} days")
    return days


def _print_unit(told: Any, on: Any) -> None:
    from bench.results.unit import coefficient_rows

    made = f"{len(told['runs'])} runs, {len(told['calibrations'])} calibrations compared"
    on.print(f"{told['unit']}: {made}{', SIMULATED' if told['simulated'] else ''}", style="bold")
    if told["calibrations"]:
        table = printing.table(
            "coefficient", ">last", ">U (k=2)", ">since the one before", ">since the first", "unit"
        )
        for row in coefficient_rows(told["calibrations"]):
            table.add_row(*row)
        on.print(table)
    printing.notes_on(on, told["notes"])
    due = told["due"]
    on.print(
        f"due {due['due']}: {due['why']}" if due else f"no date due: {told['why_not_due']}", style="bold"
    )


def _print_due(told: list[dict[str, Any]], on: Any) -> None:
    table = printing.table("due", "unit", "by", ">calibrations", "last", "")
    for row in told[:ON_SCREEN]:
        simulated = "simulated" if row["simulated"] else ""
        table.add_row(row["due"], row["unit"], row["basis"], str(row["calibrations"]), row["last"], simulated)
    if told:
        on.print(table)
    more = len(told) - ON_SCREEN
    rest = f"; {more} more are not shown: --json FILE has all" if more > 0 else ""
    counted = "1 unit" if len(told) == 1 else f"{len(told)} units"
    on.print(f"{counted} due{rest}", style="bold")
