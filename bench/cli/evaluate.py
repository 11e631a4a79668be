"""calibrate, verify, report, coefficients, compensate, tumble: what readings say of a block."""

from __future__ import annotations

from dataclasses import replace

from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, StrictFitOption, WithEstimators, app, requested
from bench.services.errors import Refused
from bench.services.requests.evaluation import (
    Calibrate,
    Coefficients,
    Compensate,
    Report,
    Tumble,
    Verify,
)


@app.command(
    cls=WithEstimators,
    epilog="Example: bench calibrate readings.csv --bench my-bench.yaml --json coefficients.json",
)
@requested
def calibrate(
    requests: list[Calibrate],
    json: JsonOption = None,
    out: OutOption = None,
    strict: StrictFitOption = False,
) -> int:
    """Coefficients with uncertainty from runs or readings files; exit status 1 where they do not fit."""
    from bench.calibration.estimators import find_estimator
    from bench.services.calibration import calibrated
    from bench.services.source import done, each, load_each, reading

    printing.check_target(json)
    asked = requests[0]
    loaded = load_each(reading(asked, *(one.source for one in requests), out=out))
    printing.bench_files(done(loaded), json)
    everyone = each(loaded, lambda source: calibrated(asked, source))
    otherwise = replace(asked, estimator=find_estimator(asked.estimator).name).otherwise
    for result in done(everyone):
        what_if = otherwise or result.source.what_if
        file = printing.write_result(result.source, "calibrate", result.to_dict(), what_if=what_if)
        if json == "-":
            printing.notes_aside(result.notes)
        else:
            printing.calibration(result, file)
    printing.write_json([one.to_dict() for one in everyone], json)
    if printing.failed(everyone):
        return 2
    accepted = [one.strictly_accepted if strict else one.accepted for one in done(everyone)]
    return 0 if all(accepted) else 1


@app.command(epilog="Example: bench verify unit-17 --coefficients last-year.json")
@requested
def verify(requests: list[Verify], json: JsonOption = None, out: OutOption = None) -> int:
    """Δg at the verification points against the limit; exit status 1 unless all are accepted."""
    from bench.services.calibration import verified
    from bench.services.source import done, each, load_each, reading
    from bench.services.verification import Asked

    printing.check_target(json)
    asked = requests[0]
    Asked.of(asked)
    loaded = load_each(reading(asked, *(one.source for one in requests), out=out))
    printing.bench_files(done(loaded), json)
    everyone = each(loaded, lambda source: verified(asked, source))
    results = done(everyone)
    for result in results:
        printing.notes_aside(result.warnings)
    for result in results:
        what_if = result.source.what_if or asked.coefficients is not None or result.otherwise
        file = printing.write_result(result.source, "verify", result.to_dict(), what_if=what_if)
        if json == "-":
            printing.notes_aside(result.notes)
        else:
            printing.verification(result, file)
    printing.write_json([one.to_dict() for one in everyone], json)
    if printing.failed(everyone):
        return 2
    return 0 if all(result.accepted for result in results) else 1


@app.command(epilog="Example: bench report unit-17")
@requested
def report(request: Report, json: JsonOption = None, out: OutOption = None) -> int:
    """Write the report of a run: one HTML page."""
    from bench.results.verification import ReportResult
    from bench.services.calibration import calibration_of
    from bench.services.source import load_sources, reading
    from bench.services.verification import Asked

    printing.check_target(json)
    asked = Asked.of(request)
    (loaded,) = load_sources(reading(request, request.source, out=out))
    on = printing.console(json=json)
    printing.bench_files([loaded], json)
    result = calibration_of(loaded)
    try:
        verdict, page = printing.report(result, on, asked)
    except OSError as error:
        raise Refused(
            f"{error.filename}: the page cannot be written ({error.strerror}); choose another place with --out DIR"
        ) from error
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


@app.command(epilog="Example: bench coefficients unit-17 --as c --as px4")
@requested
def coefficients(request: Coefficients, json: JsonOption = None, out: OutOption = None) -> int:
    """What a computer takes: N = K⁻¹, misalignments; as JSON, CSV, C, Excel, for Kalibr, PX4, ArduPilot."""
    from bench.exchange.forms import print_coefficients
    from bench.services.coefficients import forms_of, nominal_of
    from bench.services.compensation import results_of
    from bench.services.source import reading

    printing.check_target(json)
    forms = forms_of(list(request.forms or ["json"]))
    given = results_of(reading(request, *request.sources, out=out))
    nominal = nominal_of(request.nominal, [one.result for one in given])
    on = printing.console(json=json)
    asked_for = out is not None or bool(request.forms)
    for one in given:
        if one.source is not None:
            printing.bench_file(one.source.taken, json, one.source.name if len(given) > 1 else "")
        print_coefficients(one.result, on)
        for form in forms:
            file = one.file(form.suffix)
            if printing.write_beside(file, form.write(one.result, nominal), asked=asked_for):
                printing.written(form.words, file, on)
                for line in form.loses(one.result, nominal) if form.loses else ():
                    on.print(f"  {line}")
    printing.write_json([one.result.to_dict() for one in given], json)
    return 0


@app.command(epilog="Example: bench compensate unit-17-over-temperature --reference 23")
@requested
def compensate(
    request: Compensate, json: JsonOption = None, out: OutOption = None, strict: StrictFitOption = False
) -> int:
    """Coefficients as polynomials in temperature; tables (C, CSV, JSON) for a computer on board."""
    from bench.results.compensation import print_checks, print_compensation
    from bench.services.compensation import compensated
    from bench.services.source import load_sources, reading

    printing.check_target(json)
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
    printing.notes_on(on, found.model.fitted.diagnose(" ".join(found.names)))
    return 0 if found.accepted(strict=strict) else 1


@app.command(epilog="Example: bench tumble unit-17-turn-12 --terms K2,K3")
@requested
def tumble(
    request: Tumble, json: JsonOption = None, out: OutOption = None, strict: StrictFitOption = False
) -> int:
    """Each axis of a multi-point tumble by IEEE 1293: bias, scale factor, misalignments, K2, K3, Koq."""
    from bench.results.tumble import print_tumble
    from bench.services.compensation import tumbled
    from bench.services.source import load_sources, reading

    printing.check_target(json)
    loaded = load_sources(reading(request, *request.sources, out=out))
    printing.bench_files(loaded, json)
    terms = [term.strip() for term in request.terms.split(",") if term.strip()]
    results, fits = [], True
    for source in loaded:
        view, result = tumbled(source, terms)
        results.append(result.to_dict())
        fits = fits and view.lack_of_fit.accepted(strict=strict)
        file = printing.write_result(source, "tumble", results[-1], what_if=source.what_if)
        on = printing.console(json=json)
        print_tumble(view, source.name, on)
        printing.notes_on(on, result.notes)
        if file is not None:
            printing.written("result", file, on)
    printing.write_json(results, json)
    return 0 if fits else 1
