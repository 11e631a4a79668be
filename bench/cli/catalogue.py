"""catalogue: many run folders in a database, and what it answers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from bench.cli import printing
from bench.cli.options import JsonOption

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
"""Rows of a table on the screen."""
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
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
) -> int:
    """Take what is new or changed in run folders into the catalogue; mark what is gone."""
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.sync import sync as synced

    printing.check_target(json)
    on = printing.console(json=json)
    with open_catalogue(catalogue) as opened:
        done = synced(opened, folders, whole=verify)
        where = opened.where
    for path, reason in sorted(done.problems.items()):
        on.print(f"{path}: {reason}")
    bad = f", {len(done.problems)} with a problem" if done.problems else ""
    counts = (
        f"{done.added} new, {done.changed} changed, {done.moved} moved, {done.unchanged} as they were, "
        f"{done.vanished} gone{bad}"
    )
    on.print(f"{where}: {counts}", style="bold")
    printing.write_json([{"catalogue": where, **done.to_json()}], json)
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
            help="runs, coefficients, units, benches, operators, instruments, certificates or folders.",
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
    from bench.base.whole import write_whole
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
