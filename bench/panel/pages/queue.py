"""The page of the day's queue: units that a person begins one by one, state of the benches, who is on duty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from bench.base.languages import message
from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import BenchFile, Standing, load_bench, standings
from bench.config.shipped import CONFIG, PROCEDURES
from bench.panel.access import Person, Refusal, Role
from bench.panel.folder import RunRow
from bench.panel.own_files import choices, chosen_bench, chosen_procedure, offered
from bench.panel.pages.start import first_bench, printable, wished
from bench.panel.queue import DUTY, OFF_DUTY, SWITCHED_ON, DayNote, QueueItem, new_item
from bench.panel.shared import Panel, acting, looking, page, panel_of
from bench.run.events import RecordError
from bench.run.sentences import duration
from bench.services.validated import REMINDED_DAYS
from drivers.clock import utc_now

TO_DO: Final = message("to do")
WARM: Final = timedelta(hours=1)
"""The warm-up after which voltmeters meet their specification (34401A User's Guide, chapter 8)."""
MOVES: Final = {"up": -1, "down": 1}


@dataclass(frozen=True)
class QueueRow:
    """An item of the queue, with its state in words: "to do", a stage of its check, or the state of its run.

    `run` is the row of the item's run. `beginnable` says whether a person may begin the item, `returnable`
    whether a person may put it back into the queue.
    """

    item: QueueItem
    state: str
    time: str = ""
    run: RunRow | None = None
    beginnable: bool = False
    returnable: bool = False


@dataclass(frozen=True)
class BenchToday:
    """A bench of the queue today: certificates that need attention, warm-up, check block, the run in progress.

    `certificates` and `notes` are sentences; `well` is the sentence shown if all certificates are valid.
    """

    name: str
    certificates: Sequence[str] = ()
    well: str = ""
    notes: Sequence[str] = ()
    switched_on: DayNote | None = None
    warm: str = ""
    busy: str = ""


async def queue(request: Request) -> Response:
    """Show the queue, or, if a file of the queue is damaged, what to do about it."""
    person = looking(request)
    panel = panel_of(request)
    try:
        shown = await run_in_threadpool(_queue_values, panel)
    except RecordError as error:
        return page(request, "queue.html.j2", damage=str(error), may=person.role is not Role.VIEWER)
    return page(
        request,
        "queue.html.j2",
        damage="",
        may=person.role is not Role.VIEWER,
        procedures=list(choices(PROCEDURES)),
        bench_files=list(choices(CONFIG)),
        first_bench=await run_in_threadpool(first_bench, panel.runs),
        **shown,
    )


def _queue_values(panel: Panel) -> dict[str, Any]:
    runs = {row.name: row for row in panel.table.rows()}
    rows = [_row(panel, item, runs) for item in panel.queue.items()]
    to_do = [row for row in rows if row.run is None]
    left_s = sum(_expected_s(row.item) for row in to_do)
    on = panel.queue.switched_on()
    return {
        "rows": rows,
        "next_id": next((row.item.id for row in rows if row.beginnable), ""),
        "left": duration(left_s) if left_s else "",
        "until": utc_now() + timedelta(seconds=left_s),
        "number_done": sum(row.run is not None and _is_done(row.run) for row in rows),
        "benches": [
            bench_today(name, list(runs.values()), on.get(name))
            for name in dict.fromkeys(
                row.item.bench
                for row in rows
                if not row.item.dry_run and (row.run is None or not _is_done(row.run))
            )
        ],
        "duty": panel.queue.on_duty(),
    }


def _is_done(run: RunRow) -> bool:
    return run.state in {"finished", "imported"}


def _expected_s(item: QueueItem) -> float:
    file = choices(PROCEDURES).get(item.procedure)
    return 0.0 if file is None else offered(item.procedure, file).expected_s


def _row(panel: Panel, item: QueueItem, runs: dict[str, RunRow]) -> QueueRow:
    run = runs.get(item.run)
    if run is not None:
        returnable = not run.alive and not _is_done(run)
        return QueueRow(item, run.state, run=run, returnable=returnable)
    expected_s = _expected_s(item)
    time = duration(expected_s) if expected_s else ""
    if item.run and panel.queue.is_starting(item):
        return QueueRow(item, message("being started"), time)
    state = TO_DO
    if item.wish:
        try:
            wish = panel.wishes.of(item.wish)
            found = wish.found()
            checked = "checked" if found.startable else message("check found an obstacle")
            state = (
                message("being checked") if wish.at_work() else checked if found.stage == "done" else TO_DO
            )
        except Refusal:  # checks are deleted after a while
            pass
    return QueueRow(item, state, time, beginnable=True)


def next_unit(panel: Panel) -> QueueItem | None:
    """Return the first item without a run; None if there is none, or if the queue's file is damaged."""
    try:
        items = panel.queue.items()
    except RecordError:
        return None
    return next(
        (one for one in items if not panel.runs.holds(one.run) and not panel.queue.is_starting(one)), None
    )


# --- benches today ----------------------------------------------------------------------------------


def bench_today(name: str, runs: Sequence[RunRow], on: DayNote | None) -> BenchToday:
    """Return what an operator must know today of a bench; the note `on` says when it was switched on, if known."""
    busy = next((row.name for row in runs if row.alive and row.bench == Path(name).stem), "")
    try:
        if (path := choices(CONFIG).get(name)) is None:
            raise Refusal(404, f"the bench file {name} no longer exists; remove the unit and add it again")
        bench = _bench(path, path.stat().st_mtime_ns)
    except (Refusal, OSError, FileMistakes) as error:
        reason = error.text if isinstance(error, Refusal) else str(error).partition("\n")[0]
        return BenchToday(name, notes=[f"✗ {reason}"], busy=busy)
    today = utc_now().astimezone().date()
    stated = standings(bench, today)
    dates = [one.certificate.valid_until for one in stated if one.certificate.valid_until is not None]
    well = message(f"{len(stated)} certificates are valid") + (
        message(f", the first until {min(dates)}") if dates else ""
    )
    return BenchToday(
        name,
        certificates=[words for one in stated if (words := _attention(one, today))],
        well=well if stated else message("The bench file states no certificates."),
        notes=[*_warm_up(bench), *_check_block(bench, runs)],
        switched_on=on,
        warm=_warm(on),
        busy=busy,
    )


@lru_cache(maxsize=64)
def _bench(path: Path, _changed_ns: int) -> BenchFile:
    return load_bench(path)


def _attention(standing: Standing, today: date) -> str:
    """Return a sentence on a certificate that has expired or soon will; "" for any other."""
    until = standing.certificate.valid_until
    if until is None or (until - today).days > REMINDED_DAYS:
        return ""
    which = f"{standing.instrument}: certificate {standing.certificate.number}"
    if standing.expired:
        return message(f"✗ {which} expired on {until}. Have the instrument calibrated.")
    return message(
        f"! {which} is valid until {until}, {(until - today).days} more days. Plan its calibration."
    )


def _warm_up(bench: BenchFile) -> list[str]:
    supply = bench.unit_under_test.supply
    if supply is None:
        return []
    least, longest = duration(supply.warm_up_s), duration(supply.longest_warm_up_s)
    span = least if least == longest else f"{least} to {longest}"
    return [message(f"The run switches the block on and lets it warm up: {span}.")]


def _warm(on: DayNote | None) -> str:
    """Return the state of the instruments' warm-up in words; "" if nobody noted that they are switched on."""
    if on is None:
        return ""
    minutes = (utc_now() - on.at) // timedelta(minutes=1)
    left_s = WARM.total_seconds() - 60.0 * minutes
    return message(f"on for {duration(60.0 * minutes)}") + (
        message(f"; warm in {duration(left_s)}") if left_s > 0 else "; warm"
    )


def _check_block(bench: BenchFile, runs: Sequence[RunRow]) -> list[str]:
    section = bench.check_block
    if section is None:
        return []
    done = [row for row in runs if _is_done(row) and row.unit.split()[-1:] == [section.serial]]
    if not done:
        return [f"! The check block {section.serial} was not measured yet. Measure it first."]
    newest = max(done, key=lambda row: row.created)
    age_s = (utc_now() - datetime.fromisoformat(newest.created)).total_seconds()
    told = message(
        f"The check block {section.serial} was last measured {duration(age_s)} ago, by {newest.name}"
    )
    return [message(f"! {told}: measure it first.") if age_s > section.max_age else f"{told}."]


# --- changes ----------------------------------------------------------------------------------------


async def changed(request: Request) -> Response:
    """Add units, remove finished ones, note who is on duty or that a bench is on, or put damaged files aside."""
    person, sent = await acting(request, Role.OPERATOR)
    await run_in_threadpool(_changed, panel_of(request), person, sent)
    return RedirectResponse("/queue", status_code=303)


def _changed(panel: Panel, person: Person, sent: dict[str, str]) -> None:
    match sent.get("do", ""):
        case "add":
            panel.queue.add(_asked(panel, person, sent))
        case "remove done":
            runs = {row.name: row for row in panel.table.rows()}
            rows = [_row(panel, item, runs) for item in panel.queue.items()]
            panel.queue.remove([row.item.id for row in rows if row.run is not None and _is_done(row.run)])
        case "duty":
            panel.queue.note(DUTY, person)
        case "off duty":
            panel.queue.note(OFF_DUTY, person)
        case "on":
            if (bench := sent.get("bench", "")) not in choices(CONFIG):
                raise Refusal(400, "there is no bench file of that name; choose one from the list")
            panel.queue.note(SWITCHED_ON, person, bench)
        case "put aside":
            panel.queue.put_aside()
        case _:
            raise Refusal(
                400, "there is no such action for the queue; load the page again and use its buttons"
            )


def _asked(panel: Panel, person: Person, sent: dict[str, str]) -> list[QueueItem]:
    procedure, bench = sent.get("procedure", ""), sent.get("bench", "")
    chosen_procedure(procedure, panel.runs)
    chosen_bench(bench, panel.runs)
    units = [text for line in sent.get("units", "").splitlines() if (text := printable(line, "unit"))]
    dry = sent.get("dry_run", "") == "yes"
    return [new_item(unit, procedure, bench, person.name, dry_run=dry) for unit in units or [""]]


async def item_changed(request: Request) -> Response:
    """Begin, move, remove or put back an item; beginning it starts only the check, not yet the run."""
    person, sent = await acting(request, Role.OPERATOR)
    to = await run_in_threadpool(
        _item_changed, panel_of(request), person, request.path_params["item"], sent.get("do", "")
    )
    return RedirectResponse(to, status_code=303)


def _item_changed(panel: Panel, person: Person, item_id: str, do: str) -> str:
    item = panel.queue.item(item_id)
    if do == "begin":
        return f"/start/{_check_of(panel, person, item)}"
    if do in MOVES:
        panel.queue.move(item_id, MOVES[do])
    elif do == "remove":
        panel.queue.remove([item_id])
    elif do == message("put back"):
        runs = {row.name: row for row in panel.table.rows()}
        if not _row(panel, item, runs).returnable:
            raise Refusal(
                409,
                f"{item.words}: its run continues or is finished; add the unit to the queue again",
            )
        panel.queue.change(item_id, wish="", run="", begun=None)
    else:
        raise Refusal(400, "there is no such action for the queue; load the page again and use its buttons")
    return "/queue"


def _check_of(panel: Panel, person: Person, item: QueueItem) -> str:
    """Return the id of the check of an item: the check in progress or still valid, else a new one."""
    if panel.runs.holds(item.run) or panel.queue.is_starting(item):
        raise Refusal(409, f"{item.words} was begun already; see the run {item.run}")
    try:
        wish = panel.wishes.of(item.wish)
        if not wish.wanted().changed() and (wish.at_work() or wish.found().startable) and not wish.started():
            return wish.id
    except Refusal:
        pass  # there is no check that can be used
    sent = {
        "procedure": item.procedure,
        "bench": item.bench,
        "unit": item.unit,
        "dry_run": "yes" * item.dry_run,
    }
    wish = wished(panel, person, sent, item.id)
    panel.queue.change(item.id, wish=wish.id)
    return wish.id
