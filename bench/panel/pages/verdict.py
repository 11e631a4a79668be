"""The pages after a run: verdict, report, diagnosis, certificates, next measurement, plots with their numbers."""

from __future__ import annotations

from typing import Final
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from bench.base.numbers import without_infinity
from bench.certificate.register import NumberStatus
from bench.panel.access import Refusal, Role
from bench.panel.folder import read_page
from bench.panel.launching import diagnose as begin
from bench.panel.launching import last_words
from bench.panel.own_files import NEXT
from bench.panel.pages.run import run_of
from bench.panel.plots import FORMS, live_table, plots_of, sections_of, table_of, written
from bench.panel.results import DIAGNOSIS, REPORT, figure_of, is_plain, previous_calibration, results_of
from bench.panel.shared import APART, acting, page, panel_of
from bench.panel.stream import COVERAGE
from bench.run.events import RunState
from bench.run.folder import Run
from bench.services.errors import Refused

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


# --- plots --------------------------------------------------------------------------------------------

LIVE = "live"
"""The table of the residuals from predictions, which the live page of a run plots."""


async def plots(request: Request) -> Response:
    """Show the plots of a finished run; the script then asks for their numbers."""
    found = run_of(request)
    return page(request, "plots.html.j2", run=found, sections=sections_of(found))


async def data(request: Request) -> Response:
    """Send the numbers of a run's plots, see `bench.panel.plots.plots_of`."""
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
