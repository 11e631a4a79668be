"""calibrate, verify, report, coefficients, compensate, tumble, diagnose, confirm, accept: results of readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from bench.base.computing import one_thread
from bench.base.text import as_typed
from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, StrictFitOption, command
from bench.services.errors import refusing
from bench.services.requests.evaluation import (
    Accept,
    Calibrate,
    Coefficients,
    Compensate,
    Confirm,
    Diagnose,
    Report,
    Tumble,
    Verify,
)

if TYPE_CHECKING:
    from bench.services.diagnosis import Diagnosed
    from bench.services.source import Failed, Source

T = TypeVar("T")


@command("bench calibrate readings.csv --bench my-bench.yaml --json coefficients.json")
def calibrate(
    requests: list[Calibrate],
    json: JsonOption = None,
    out: OutOption = None,
    strict: StrictFitOption = False,
) -> int:
    """Compute coefficients and their uncertainty from readings.

    Exit status 1 if readings and model do not fit.
    """
    from bench.calibration.estimators import find_estimator
    from bench.services.calibration import calibrated
    from bench.services.source import done

    asked = requests[0]
    everyone = _each(requests, lambda source: calibrated(asked, source), json, out)
    otherwise = replace(asked, estimator=find_estimator(asked.estimator).name).otherwise
    results: list[printing.Calibrated] = done(everyone)
    for result in results:
        printing.evaluated(result, "calibrate", json, what_if=otherwise)
    printing.write_json([one.to_dict() for one in everyone], json)
    if printing.failed(everyone):
        return 2
    accepted = [one.strictly_accepted if strict else one.accepted for one in results]
    return 0 if all(accepted) else 1


def _each(
    requests: Sequence[Calibrate | Verify], work: Callable[[Source], T], json: str | None, out: Path | None
) -> list[T | Failed]:
    """Read each request's source and print its bench file; return what `work` on it gives, or a `Failed`."""
    from bench.services.source import done, each, load_each, reading

    loaded = load_each(reading(requests[0], *(one.source for one in requests), out=out))
    printing.bench_files(done(loaded), json)
    return each(loaded, work)


@command("bench verify unit-17 --coefficients last-year.json")
def verify(requests: list[Verify], json: JsonOption = None, out: OutOption = None) -> int:
    """Compare Δg at the verification points with the limit.

    Exit status 1 unless all points are accepted.
    """
    from bench.services.calibration import verified
    from bench.services.source import done
    from bench.services.verification import VerdictOptions

    asked = requests[0]
    VerdictOptions.of(asked)
    everyone = _each(requests, lambda source: verified(asked, source), json, out)
    results = done(everyone)
    for result in results:
        what_if = asked.coefficients is not None or result.otherwise
        printing.evaluated(result, "verify", json, what_if=what_if)
        if json == "-":
            printing.notes_aside(result.warnings)
        else:
            printing.console().print(result.verdict(), style="bold")
    printing.write_json([one.to_dict() for one in everyone], json)
    if printing.failed(everyone):
        return 2
    return 0 if all(result.passed for result in results) else 1


@command("bench report unit-17")
def report(request: Report, json: JsonOption = None, out: OutOption = None) -> int:
    """Write the report of a run as one HTML page.

    Exit status 1 if the fit or the verification is not accepted.
    """
    from bench.results.verification import ReportResult
    from bench.services.calibration import result_of
    from bench.services.source import load_sources, reading
    from bench.services.verification import VerdictOptions

    asked = VerdictOptions.of(request)
    (loaded,) = load_sources(reading(request, request.source, out=out))
    on = printing.console(json=json)
    printing.bench_files([loaded], json)
    result = result_of(loaded)
    with refusing("choose another place with --out DIR"):
        verdict, page = printing.report(result, on, asked)
    if verdict is not None:
        printing.notes_on(on, verdict.sentences)
        on.print(verdict.verdict(), style="bold")
    written = ReportResult(
        report=str(page),
        bench=loaded.taken.part(),
        verification=None if verdict is None else verdict.result(),
    )
    printing.write_json([written.to_dict()], json)
    return 0 if result.accepted and (verdict is None or verdict.passed) else 1


@command("bench coefficients unit-17 --as c --as px4")
def coefficients(request: Coefficients, json: JsonOption = None, out: OutOption = None) -> int:
    """Write coefficients for other software: JSON, CSV, C, Excel, Kalibr, PX4, ArduPilot.

    Exit status 1 if the readings contradict the model.
    """
    from bench.exchange.forms import print_coefficients
    from bench.services.coefficients import forms_of, nominal_of, require_temperature
    from bench.services.compensation import results_of
    from bench.services.source import reading

    forms = forms_of(list(request.forms or ["json"]))
    given = results_of(reading(request, *request.sources, out=out))
    require_temperature([one.result for one in given], without=request.without_temperature)
    nominal = nominal_of(request.nominal, [one.result for one in given])
    on = printing.console(json=json)
    asked_for = out is not None or bool(request.forms)
    for one in given:
        if one.source is not None:
            printing.bench_file(one.source.taken.part(), json, one.source.name if len(given) > 1 else "")
        print_coefficients(one.result, on)
        for form in forms:
            file = one.file(form.suffix)
            if printing.write_beside(file, form.write(one.result, nominal), asked=asked_for):
                printing.written(form.words, file, on)
                for line in form.loses(one.result, nominal) if form.loses else ():
                    on.print(f"  {line}")
    printing.write_json([one.result.to_dict() for one in given], json)
    return 0 if all(one.result.fits for one in given) else 1


@command("bench compensate unit-17-over-temperature --reference 23")
def compensate(
    request: Compensate, json: JsonOption = None, out: OutOption = None, strict: StrictFitOption = False
) -> int:
    """Fit coefficients as polynomials in temperature; write tables for an onboard computer."""
    from bench.results.compensation import print_checks, print_compensation
    from bench.services.compensation import compensated
    from bench.services.source import load_sources, reading

    loaded = load_sources(reading(request, *request.sources, out=out))
    on = printing.console(json=json)
    printing.bench_files(loaded, json)
    found = compensated(request, loaded)
    written = [
        (what, file)
        for what, file, text in found.files()
        if printing.write_beside(file, text, asked=out is not None)
    ]
    print_compensation(found.model, found.table, found.names, on)
    print_checks(found.checks, on)
    for what, file in written:
        printing.written(what, file, on)
    printing.write_json([found.result.to_dict()], json)
    printing.notes_on(on, found.model.fitted.diagnose(" ".join(map(as_typed, found.names))))
    return 0 if found.accepted(strict=strict) else 1


@command("bench tumble unit-17-turn-12 --terms K2,K3")
def tumble(
    request: Tumble, json: JsonOption = None, out: OutOption = None, strict: StrictFitOption = False
) -> int:
    """Fit each axis of a multi-point tumble by IEEE 1293: bias, scale factor, misalignments, K2, K3, Koq."""
    from bench.results.compensation import print_tumble
    from bench.services.compensation import tumbled
    from bench.services.source import load_sources, reading

    loaded = load_sources(reading(request, *request.sources, out=out))
    printing.bench_files(loaded, json)
    results, fits = [], True
    for source, (view, result) in zip(loaded, tumbled(request, loaded), strict=True):
        results.append(result.to_dict())
        fits = fits and view.lack_of_fit.accepted(strict=strict) and view.above_agrees
        file = printing.write_result(source, "tumble", results[-1], what_if=source.what_if)
        on = printing.console(json=json)
        print_tumble(view, source.name, on)
        printing.notes_on(on, result.notes)
        if file is not None:
            printing.written("result", file, on)
    printing.write_json(results, json)
    return 0 if fits else 1


@command("bench diagnose unit-17 --json diagnosis.json")
def diagnose(
    request: Diagnose,
    together: Annotated[
        bool, typer.Option("--together", help="Diagnose all sources, of one bench, as one system.")
    ] = False,
    json: JsonOption = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit status 1 if anything is found.")] = False,
) -> int:
    """Find the effect that explains why readings and model disagree.

    Name the missing effect, add it to the model, and show how the gap shrinks.
    """
    results = carried_out(request, json, together=together)
    if printing.failed(results):
        return 2
    from bench.services.source import done

    return 1 if strict and any(one.verdict != "agrees" for one in done(results)) else 0


def carried_out(request: Diagnose, target: str | None, *, together: bool) -> list[Diagnosed | Failed]:
    """Diagnose the sources, write their files and the JSON `target`, print and return the results.

    With `together`, the readings of all sources are diagnosed as one set.
    """
    one_thread()
    from bench.services.bodies import single_bodies, whole_body
    from bench.services.diagnosis import diagnosed, print_diagnosed
    from bench.services.source import done

    bodies = [whole_body(request)] if together else single_bodies(request)
    printing.bench_files([body.source for body in done(bodies)], target)
    with printing.progress():
        results = diagnosed(replace(request, write=True), bodies)
    printing.notes_aside(note for one in done(results) for note in one.not_written)
    printing.write_json([one.to_dict() for one in results], target)
    print_diagnosed(results, printing.console(json=target))
    return results


@command("bench confirm unit-18 --model runs/unit-17/diagnose-model.yaml")
def confirm(request: Confirm, json: JsonOption = None) -> int:
    """Test a diagnosed model on new readings.

    State how much better the model predicts the new readings. Exit status 1 unless the model
    is confirmed.
    """
    one_thread()
    from bench.services.confirmation import confirmation_of
    from bench.services.source import load_sources, reading

    (source,) = load_sources(reading(request, request.source))
    printing.bench_files([source], json)
    with printing.progress():
        result = confirmation_of(source)
    printing.write_json([result.to_dict()], json)
    result.print_on(printing.console(json=json))
    return 0 if result.confirmed else 1


@command("bench accept diagnose/unit-17-model.yaml --name cable_pull --sentence 'the cable pulls'")
def accept(request: Accept) -> int:
    """Name and describe the unnamed terms that a diagnosis found."""
    from bench.services.own_effects import accept_terms

    effects, model = accept_terms(request)
    told = printing.console()
    told.print(f"effect: {effects}")
    told.print(f"model: {model}")
    told.print(f"from now on: --effects {effects}, or BENCH_EFFECTS={effects}")
    return 0
