"""What the terminal shows at the end of a run: the verdict, the files, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bench.base.computing import quiet
from bench.config.shipped import CONFIG, PROCEDURES, shipped_folder
from bench.services.requests.shared import name_to_type

if TYPE_CHECKING:
    from bench.run.folder import Run
    from bench.services.conclusion import Conclusion

MOST_LINES: Final = 15
"""Largest number of lines of an ending."""
_MOST_SENTENCES: Final = 2


def ending(found: Conclusion) -> list[str]:
    """Return the lines at the end of a run: verdict (that on the check block first), basis, files, what to do."""
    chart = [] if found.chart is None else [found.chart.sentence()]
    lines = [*chart, _verdict(found), *_basis(found)]
    if found.no_chart:
        lines.append(f"check block: no control chart: {found.no_chart}")
    lines += _shortened(
        [f"note: {look}" for look in found.looks], f"bench diagnose {name_to_type(found.run.folder)}"
    )
    return [*lines, *_files(found), *_next(found)]


def _verdict(found: Conclusion) -> str:
    from bench.results.verification import outcome_in_words

    name = f"{found.run.name} (SIMULATED)" if found.run.simulated else found.run.name
    if found.calibration is None:
        return f"{name}: MEASURED; no calibration from it: {found.no_calibration}"
    if not found.calibration.accepted:
        return f"{name}: NOT ACCEPTED: the model does not fit the readings"
    if found.verification is not None:
        return outcome_in_words(name, found.verification.verification)
    return f"{name}: CALIBRATED; no verdict, as the procedure has no verification points"


def _basis(found: Conclusion) -> Iterator[str]:
    from bench.results.calibration import fit_in_a_line
    from bench.results.verification import basis_in_words, outcome_in_words

    if found.short:
        goals = ", ".join(found.run.manifest.get("until", ()))
        yield f"NOT REACHED: {goals}; no further point of the procedure would help"
    if found.calibration is not None:
        yield fit_in_a_line(found.calibration.calibration)
    if found.verification is None:
        return
    if found.calibration is not None and not found.calibration.accepted:
        yield outcome_in_words("verification points", found.verification.verification)
    yield basis_in_words(found.verification.verification)
    if not found.verification.passed:
        yield from found.verification.sentences[:_MOST_SENTENCES]


def _shortened(lines: list[str], elsewhere: str) -> list[str]:
    rest = len(lines) - _MOST_SENTENCES
    return (
        lines
        if rest <= 1
        else [*lines[:_MOST_SENTENCES], f"note: {rest} more notes; '{elsewhere}' explains them"]
    )


def _files(found: Conclusion) -> Iterator[str]:
    folder, name = found.run.folder, name_to_type(found.run.folder)
    yield f"readings: {len(found.source.readings)}, kept in {folder}"
    if found.report is not None:
        count = len(found.calibration.notes) if found.calibration is not None else 0
        notes = f" (with {count} note{'s' * (count != 1)})" if count and not quiet.get() else ""
        yield f"report: {found.report}{notes}"
        yield f"coefficients: {folder / 'calibrate.json'} ('bench calibrate {name}' prints them)"
    if found.chart is not None and not found.chart_unwritten:
        yield f"chart: {folder / 'chart.json'} ('bench chart {folder.parent} --page FILE' draws it)"


def _next(found: Conclusion) -> Iterator[str]:
    run, name = found.run, name_to_type(found.run.folder)
    again = _run_again(run)
    verification = found.verification
    if found.calibration is None:
        yield f"next: bench show {name}"
    elif not found.calibration.accepted or (verification is not None and verification.statement == "fail"):
        yield f"next: bench diagnose {name}"
    elif verification is not None and not verification.passed:
        yield f"next: {again.replace('bench run', 'bench budget', 1)}, which shows what makes U large"
    elif found.chart is not None and not found.chart.accepted:
        yield f"next: find the cause, then repeat the run: {again}"
    elif run.simulated:
        yield f"next: on real instruments: {again}{'' if ' --bench ' in again else ' --bench FILE'}"
    else:
        if verification is not None and found.chart is None:
            yield f"next: bench certificate {name}"
        yield f"next unit: {again} --unit SERIAL"


def _run_again(run: Run) -> str:
    """Return the command that carries out the procedure of a run on another block."""
    procedure = _typed(str(run.manifest.get("procedure", "PROCEDURE")), PROCEDURES)
    asked = run.manifest.get("bench_why") == "as asked for"
    return f"bench run {procedure}" + (f" --bench {_typed(run.manifest['bench'], CONFIG)}" if asked else "")


def _typed(file: str, kind: str) -> str:
    """Return a file as a user may type it on the command line; a shipped file is typed by its name."""
    path = Path(file)
    return path.stem if path.parent == shipped_folder(kind) else file
