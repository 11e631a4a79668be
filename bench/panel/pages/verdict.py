"""The pages after a run: verdict, report, diagnosis, certificates, next measurement, plots with their numbers."""

from __future__ import annotations

import csv
import io
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from bench.base.languages import message
from bench.base.numbers import without_infinity
from bench.base.text import visible
from bench.base.yaml_files import FileMistakes
from bench.certificate.register import NumberStatus
from bench.panel.access import Refusal, Role
from bench.panel.folder import RunsFolder, read_page
from bench.panel.launching import diagnose as begin
from bench.panel.launching import last_words
from bench.panel.own_files import NEXT
from bench.panel.pages.run import run_of
from bench.panel.results import (
    DIAGNOSIS,
    REPORT,
    figure_of,
    is_plain,
    previous_calibration,
    results_of,
    told_by,
)
from bench.panel.shared import APART, acting, page, panel_of
from bench.panel.stream import COVERAGE
from bench.readings.csv import ReadingsError
from bench.run.events import EVENTS, RecordError, RunState
from bench.run.folder import BENCH, CALIBRATE_FILE, DIAGNOSE_FILE, VERIFY_FILE, Run
from bench.services.errors import Refused

Numbers = dict[str, Any]
Rows = list[list[Any]]


# --- the numbers of the plots of a finished run -----------------------------------------------------------


def plots_of(run: Run, runs: RunsFolder) -> Numbers:
    """Return the numbers of all plots of a run as a JSON object, with null for a plot that the run lacks.

    `previous` is residuals and Δg of the unit's previous calibration, `trouble` a sentence per unusable file.
    """
    trouble: list[str] = []
    own = _measured(run, trouble)
    earlier = previous_calibration(run, runs)
    before = None if earlier is None else _measured(earlier, trouble)
    units = {one["residuals"]["unit"] for one in (own, before) if one and one["residuals"]}
    if before and len(units) > 1:
        before["residuals"] = None
    told = {
        "run": run.name,
        "simulated": run.simulated,
        "k": COVERAGE,
        **own,
        "previous": before and {"run": earlier and earlier.name, **before},
        "diagnosis": told_by(run, DIAGNOSE_FILE, _diagnosis, trouble),
        "trouble": trouble,
    }
    cleaned: Numbers = without_infinity(told)
    return cleaned


def _measured(run: Run, trouble: list[str]) -> Numbers:
    """Return the residuals and Δg of a run; a sentence in `trouble` says why there are no residuals."""
    fitted: Fitted | None = None
    if is_plain(run.folder / CALIBRATE_FILE):
        try:
            fitted = _fitted(run)
        except (Refused, RecordError, FileMistakes, ReadingsError, OSError, ValueError) as error:
            trouble.append(message(f"{run.name}: its residuals cannot be computed: {error}"))
    else:
        trouble.append(message(f"{run.name} has no calibration yet."))
    times = {} if fitted is None else fitted.times
    return {
        "residuals": fitted and {"unit": fitted.unit, "points": list(fitted.points)},
        "delta_g": told_by(run, VERIFY_FILE, lambda told: _delta_g(told, times), trouble),
    }


@dataclass(frozen=True)
class Fitted:
    """The points of the residual plots, and the time (s) of each verification point by (pass, point)."""

    unit: str
    points: tuple[Numbers, ...]
    times: Mapping[tuple[int, int], float]


_COMPUTING: Final = threading.Lock()


def _fitted(run: Run) -> Fitted:
    """Return the residuals of a run's calibration. Raises the errors of `load_sources` and `calibration_of`."""
    stamps = []
    for name in (EVENTS, BENCH, CALIBRATE_FILE):
        found = (run.folder / name).stat()
        stamps.append((found.st_mtime_ns, found.st_size))
    with _COMPUTING:  # two pages at once wait for one computation
        return _calibrated(run.folder, tuple(stamps))


@lru_cache(maxsize=32)
def _calibrated(folder: Path, _stamps: tuple[tuple[int, int], ...]) -> Fitted:
    from bench.results.diagnosis_parts import (  # the analyses take long to import
        fitted_readings,
        residuals_of,
    )
    from bench.services.calibration import calibration_of
    from bench.services.source import Request, load_sources

    (source,) = load_sources(Request([str(folder)], folder.parent))
    found = calibration_of(source).calibration
    points = tuple(
        {**reading, "residual": residual}
        for reading, residual in zip(fitted_readings(found), residuals_of(found), strict=True)
    )
    checked = source.readings.verification()
    columns = (checked.pass_number, checked.point, checked.time_s)
    times = {(n, point): time for n, point, time in zip(*(c.tolist() for c in columns), strict=True)}
    return Fitted(found.unit, points, times)


def _delta_g(told: Mapping[str, Any], times: Mapping[tuple[int, int], float]) -> Numbers:
    points = [
        {
            "pass": one.get("pass"),
            "point": one.get("point"),
            "angle_deg": float(one["angle_deg"]),
            "time_s": times.get((one.get("pass"), one.get("point"))),
            "delta_g": float(one["delta_g"]),
            "u": float(one["u"]),
            "U": float(one.get("U", COVERAGE * float(one["u"]))),
            "k": float(one.get("k", COVERAGE)),
            "passed": bool(one["passed"]),
        }
        for one in told["points"]
    ]
    return {"limit_g": float(told["limit_g"]), "points": points}


def _diagnosis(told: Mapping[str, Any]) -> Numbers:
    """Return the numbers of the figures that only a diagnosis has, as far as its result contains them."""
    shown = told.get("simulation") or {}
    delta_g = {
        name: [_simulated(point) for point in shown[name]["delta_g"] if point["delta_g"] is not None]
        for name in ("before", "after")
        if shown.get(name)
    }
    folds = (told.get("gap") or {}).get("held_out", ())
    return {
        "verdict": str(told["verdict"]),
        "residuals": told.get("residuals"),
        "older": bool(shown) and told.get("residuals") is None,
        "delta_g": delta_g if any(delta_g.values()) else None,
        "held_out": [{name: fold[name] for name in ("what", "before", "after")} for fold in folds],
        "ranking": [
            {"found": str(effect["name"]), "rivals": [_rival(one) for one in rivals]}
            for effect, rivals in zip(_effects_of(told), told.get("ranking", ()), strict=False)
            if rivals
        ],
    }


def _effects_of(told: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the effects that a diagnosis found; mistakes, which precede them and have no rivals, are left out."""
    effects = list(told.get("effects", ()))
    return effects[len(effects) - len(told.get("ranking", ())) :]


def _rival(one: Mapping[str, Any]) -> Numbers:
    return {"name": str(one["name"]), "ln_odds": float(one["ln_odds"]), "tied": bool(one["tied"])}


def _simulated(point: Mapping[str, Any]) -> Numbers:
    u = float(point["u"] or 0.0)
    where = {name: point[name] for name in ("pass", "point", "angle_deg")}
    return {**where, "delta_g": float(point["delta_g"]), "u": u, "U": COVERAGE * u, "k": COVERAGE}


# --- the same numbers as tables -------------------------------------------------------------------------

FORMS: Final = {
    "csv": "text/csv; charset=utf-8",
    "xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet",
}
"""The forms of a table, each with its media type."""

_WHERE: Final = ("installation", "series", "pass", "point", "direction", "angle_deg", "time_s")
_AT: Final = ("pass", "point", "angle_deg", "time_s", "delta_g", "u", "U", "k", "passed")
_SIMULATED: Final = ("pass", "point", "angle_deg", "delta_g", "u", "U", "k")
_JUDGED: Final = ("n", "installation", "series", "pass", "point", "angle_deg", "time_s")


def table_of(plots: Numbers, name: str) -> Rows:
    """Return a plot's numbers as a table with a header row. Raises `Refusal` (404) if the run lacks the plot."""
    found = list(_rows(plots, name))
    if len(found) < 2:  # a header row alone
        raise Refusal(404, "the run has no such table; choose one on the page")
    return found


def live_table(points: Iterable[Numbers]) -> Rows:
    """Return the readings of a run in progress minus their predictions, as a table with a header row."""
    head = [*_JUDGED, *_by_channel("residual"), *_by_channel("u"), "redone", "unit"]
    rows = [
        [*(one[key] for key in _JUDGED), *one["residual"], *one["u"], one["struck"], one["unit"]]
        for one in points
    ]
    return [head, *rows]


def _by_channel(name: str) -> list[str]:
    return [f"{name}_{channel}" for channel in "xyz"]


def _rows(plots: Numbers, name: str) -> Iterator[list[Any]]:
    runs = [one for one in (plots, plots["previous"]) if one]
    match name:
        case "residuals":
            yield ["run", *_WHERE, *_by_channel("residual"), *_by_channel("u"), "unit"]
            for run in runs:
                for one in (run["residuals"] or {"points": ()})["points"]:
                    values = (*one["residual"], *one["u"], run["residuals"]["unit"])
                    yield [run["run"], *(one[key] for key in _WHERE), *values]
        case "delta-g":
            yield ["run", *_AT, "limit_g"]
            for run in runs:
                for one in (run["delta_g"] or {"points": ()})["points"]:
                    yield [run["run"], *(one[key] for key in _AT), run["delta_g"]["limit_g"]]
        case _:
            yield from _diagnosed_rows(plots["diagnosis"] or {}, name)


def _diagnosed_rows(diagnosis: Numbers, name: str) -> Iterator[list[Any]]:
    match name:
        case "diagnosis":
            parts = ("signal", "before", "after", "simulated", "u")
            yield [*_WHERE, *(column for part in parts for column in _by_channel(part)), "unit"]
            for one in (diagnosis.get("residuals") or {"readings": ()})["readings"]:
                values = [value for part in parts for value in one[part] or [None] * 3]
                yield [*(one[key] for key in _WHERE), *values, diagnosis["residuals"]["unit"]]
        case "diagnosis-delta-g":
            yield ["model", *_SIMULATED]
            for model, points in (diagnosis.get("delta_g") or {}).items():
                for one in points:
                    yield [model, *(one[key] for key in _SIMULATED)]
        case "held-out":
            yield ["held out", "before", "after"]
            yield from ([one["what"], one["before"], one["after"]] for one in diagnosis.get("held_out", ()))
        case "ranking":
            yield ["found", "name", "ln_odds", "tied"]
            for one in diagnosis.get("ranking", ()):
                for rival in one["rivals"]:
                    yield [one["found"], rival["name"], rival["ln_odds"], rival["tied"]]


def written(rows: Rows, title: str, form: str, *, simulated: bool) -> bytes:
    """Return a table as a CSV file (`form` "csv", exact numbers) or an Excel workbook ("xlsx", 16 digits)."""
    if form == "xlsx":
        from bench.exchange.forms import tables_workbook

        return tables_workbook({title: rows}, simulated=simulated)
    out = io.StringIO()
    if simulated:
        out.write("# SIMULATED: the instruments were simulated\r\n")
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerows([_cell(value) for value in row] for row in rows)
    return out.getvalue().encode()


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        return visible(value)
    return repr(value) if isinstance(value, float) else value


def sections_of(run: Run) -> Sequence[str]:
    """Return the names of the plots whose result files the run has."""
    files = {"residuals": CALIBRATE_FILE, "delta-g": VERIFY_FILE, "diagnosis": DIAGNOSE_FILE}
    return [name for name, file in files.items() if is_plain(run.folder / file)]


# --- verdict, report, diagnosis, certificates ---------------------------------------------------------

MOST_TOLD: Final = 50


def verdict(request: Request) -> Response:
    """Show the results of a run."""
    run = run_of(request)
    diagnosing = panel_of(request).diagnosing.get(run.name)
    certificates, trouble = _certificates(request, run)
    return page(
        request,
        "verdict.html.j2",
        run=run,
        manifest=run.manifest,
        found=results_of(run),
        certificates=certificates,
        trouble=trouble,
        further=is_plain(run.folder / NEXT),
        finished=run.history.state is RunState.FINISHED,
        unmade=run.results_missing and run.history.state is RunState.FINISHED,
        diagnosing=diagnosing is not None and diagnosing.status is None,
        not_diagnosed=last_words(diagnosing.log) if diagnosing is not None and diagnosing.status == 2 else "",
    )


VIEWS: Final = {"report": ("Report", REPORT), "diagnosis": ("Diagnosis", DIAGNOSIS)}


def view(request: Request) -> Response:
    """Show the report or the diagnosis of a run in a page with the panel's header."""
    run, what = run_of(request), request.path_params["what"]
    title, file = VIEWS.get(what, ("", ""))
    if not title:
        raise Refusal(404, "the run has no such page; go back to the run")
    read_page(run, file)  # says what is missing, in the panel's own page
    here = f"/runs/{quote(run.name)}"
    return page(
        request,
        "framed.html.j2",
        title=f"{title} of {run.name}",
        frame=f"{here}/{what}",
        back=f"{here}/verdict",
    )


def report(request: Request) -> Response:
    """Send the report of a run from its folder, unchanged."""
    return _apart(read_page(run_of(request), REPORT), "text/html; charset=utf-8")


def diagnosis(request: Request) -> Response:
    """Send the page of the diagnosis of a run."""
    return _apart(read_page(run_of(request), DIAGNOSIS), "text/html; charset=utf-8")


def certificate(request: Request) -> Response:
    """Send a file of a run's certificate (PDF or XML) as a download."""
    run, name = run_of(request), request.path_params["file"]
    content = panel_of(request).certificates.file(run, name)
    kind = "application/pdf" if name.endswith(".pdf") else "application/xml"
    return Response(content, media_type=kind, headers={**APART, "content-disposition": "attachment"})


def figure(request: Request) -> Response:
    """Send a figure of the report as an SVG file."""
    return _apart(figure_of(run_of(request), request.path_params["figure"]), "image/svg+xml")


async def diagnose(request: Request) -> Response:
    """Start a separate process that diagnoses a run."""
    await acting(request, Role.OPERATOR)
    panel = panel_of(request)
    run = panel.runs.run(request.path_params["name"])
    at_work = [one for one in panel.diagnosing.values() if one.status is None]
    before = panel.diagnosing.get(run.name)
    if before is None or before.status is not None:
        if len(at_work) >= 2:
            raise Refusal(429, "two runs are being diagnosed already; wait until one is done")
        for old in [name for name, one in panel.diagnosing.items() if one.status is not None][:-MOST_TOLD]:
            del panel.diagnosing[old]
        panel.diagnosing[run.name] = await run_in_threadpool(begin, run)
    return RedirectResponse(f"/runs/{quote(run.name)}/verdict#diagnosis", status_code=303)


def _certificates(request: Request, run: Run) -> tuple[dict[str, NumberStatus], str]:
    """Return the certificates of a run, and the reason if they cannot be read."""
    try:
        return panel_of(request).certificates.of(run), ""
    except Refused as why:
        return {}, why.typed


def _apart(content: bytes, kind: str) -> Response:
    return Response(content, media_type=kind, headers=APART)


# --- the page of the plots ------------------------------------------------------------------------------

LIVE = "live"
"""The table of the residuals from predictions, which the live page of a run plots."""


async def plots(request: Request) -> Response:
    """Show the plots of a finished run; the script then asks for their numbers."""
    found = run_of(request)
    return page(request, "plots.html.j2", run=found, sections=sections_of(found))


async def data(request: Request) -> Response:
    """Send the numbers of a run's plots, see `bench.panel.pages.verdict.plots_of`."""
    found = run_of(request)
    return JSONResponse(await run_in_threadpool(plots_of, found, panel_of(request).runs))


async def previous(request: Request) -> Response:
    """Send the points of the live residual plot of the unit's previous calibration, if there is one."""
    found, panel = run_of(request), panel_of(request)
    earlier = await run_in_threadpool(previous_calibration, found, panel.runs)
    points = () if earlier is None else await panel.followers.points(earlier.folder)
    told = {"run": earlier.name if earlier else "", "k": COVERAGE, "points": points}
    return JSONResponse(without_infinity(told))


async def table(request: Request) -> Response:
    """Send the numbers of a plot as a CSV file or an Excel workbook."""
    found, panel = run_of(request), panel_of(request)
    name, form = request.path_params["table"], request.path_params["form"]
    if form not in FORMS:
        raise Refusal(404, f"there is no such file format; choose one of {', '.join(FORMS)}")
    if name == LIVE:
        rows = live_table(without_infinity(await panel.followers.points(found.folder)))
    else:
        rows = table_of(await run_in_threadpool(plots_of, found, panel.runs), name)
    content = await run_in_threadpool(written, rows, name, form, simulated=found.simulated)
    return Response(content, media_type=FORMS[form], headers={"content-disposition": "attachment"})
