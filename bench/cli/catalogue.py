"""catalogue: a database of many run folders, and queries on it."""

from __future__ import annotations

from typing import Final

from bench.cli import printing
from bench.cli.options import JsonOption, command, group
from bench.services.requests.documents import Ask, DueUnits, Sync, Unit

GROUP: Final = group(
    "catalogue",
    "bench catalogue sync runs && bench catalogue ask meter=MY53200001 after=2026-05-03 --of units",
)


@command("bench catalogue sync runs /data/bench-2/runs", to=GROUP)
def sync(request: Sync, json: JsonOption = None) -> int:
    """Add new and changed runs to the catalogue; mark deleted ones."""
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.sync import sync as synced
    from bench.catalogue.unit import due_units

    on = printing.console(json=json)
    with open_catalogue(request.catalogue, renew=True) as opened:
        if opened.renewed:
            on.print(f"{opened.where}: {opened.renewed}")
        result = synced(opened, request.folders, whole=request.verify).result(opened.where)
        result.print_on(on)
        printing.write_json([result.to_dict()], json)
        if request.due:
            due_units(opened, [])
    return 0


@command("bench catalogue ask meter=MY53200001 after=2026-05-03 --of units --csv units.csv", to=GROUP)
def ask(request: Ask, json: JsonOption = None) -> int:
    """List the runs, units, benches, instruments or certificates that meet conditions."""
    from bench.catalogue.questions import answer
    from bench.catalogue.store import open_catalogue

    query = request.query or []
    with open_catalogue(request.catalogue, existing=True) as opened:
        found = answer(opened, query, request.of)
    on = printing.console(json=json)
    for file, write in ((request.csv, found.write_csv), (request.parquet, found.write_parquet)):
        if file is not None:
            write(file)
            printing.written(request.of, file, on)
    result = found.result(query, request.of)
    if json != "-":
        result.print_on(on)
    printing.write_json([result.to_dict()], json)
    return 0


@command("bench catalogue unit 17-042 --page unit.html", to=GROUP)
def unit(request: Unit, json: JsonOption = None) -> int:
    """Show the coefficients of a unit over time, its runs and its due date."""
    from bench.base.files import write_whole
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import unit_history
    from bench.results.catalogue import unit_page

    with open_catalogue(request.catalogue, existing=True) as opened:
        result = unit_history(opened, request.name, limit_g=request.limit, interval_days=request.interval)
    on = printing.console(json=json)
    if json != "-":
        result.print_on(on)
    if request.page is not None:
        write_whole(request.page, unit_page(result))
        printing.written("page", request.page, on)
    printing.write_json([result.to_dict()], json)
    return 0


@command("bench catalogue due bench=stand-2 --before 2027-01-01", to=GROUP)
def due(request: DueUnits, json: JsonOption = None) -> int:
    """List the dates when units are due for calibration, earliest first."""
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import due_units, until_day

    until = until_day(request.before)
    with open_catalogue(request.catalogue, existing=True) as opened:
        result = due_units(
            opened, request.query or [], limit_g=request.limit, interval_days=request.interval, before=until
        )
    if json != "-":
        result.print_on(printing.console(json=json))
    printing.write_json([result.to_dict()], json)
    return 0


@command("bench catalogue keys", to=GROUP)
def keys() -> int:
    """List the keys of conditions and their meaning."""
    from bench.catalogue.questions import KEYS

    table = printing.table("key", "what it asks for")
    for name, key in KEYS.items():
        table.add_row(name, key.meaning)
    printing.console().print(table)
    return 0
