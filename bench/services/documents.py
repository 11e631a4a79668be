"""A calibration for others: its page, and the forms in which others read it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import from_text, read_regular, write_whole
from bench.base.numbers import read_number
from bench.base.text import repeated
from bench.calibration.estimators import CLOSED_FORM
from bench.calibration.result import Calibration, CalibrationError
from bench.exchange.forms import FORMS
from bench.exchange.result import BlockResult
from bench.run.events import MANIFEST
from bench.services.calibration import CalibrationResult, calibration_of
from bench.services.coefficients import block_result
from bench.services.errors import Refused
from bench.services.own_effects import knowing_effects_of
from bench.services.provenance import provenance
from bench.services.source import Request, Source, load_sources
from bench.services.verification import NOTHING_ASKED, Asked, VerificationResult, verification_of


def report_page(
    result: CalibrationResult, asked: Asked = NOTHING_ASKED
) -> tuple[str, VerificationResult | None]:
    """Verify, where there are verification points; return the page (HTML) and the verification in it."""
    from bench.results.page import ReportContent, render_report

    source = result.source
    verdict = verification_of(source, result, asked) if len(source.readings.verification()) else None
    content = ReportContent(
        title=f"Calibration of {source.block_name or source.name}",
        calibration=result.calibration,
        verification=None if verdict is None else verdict.verification,
        compared=_closed_form(source),
        provenance=provenance(source),
        notes=(*result.doubts, *result.calibration.notes, *source.readings.notes),
        skipped=source.readings.skipped,
        simulated=source.simulated,
    )
    with knowing_effects_of(source):
        return render_report(content), verdict


def _closed_form(source: Source) -> Calibration | None:
    """The paper's estimator beside ours, where the readings are such that it applies."""
    try:
        return calibration_of(source, CLOSED_FORM).calibration
    except CalibrationError:
        return None


ALL = "all"


@dataclass(frozen=True)
class Given:
    """A calibration to be written: `result`, and where its files go; `source` is None for a JSON file's."""

    result: BlockResult
    stem: Path
    source: Source | None

    def file(self, suffix: str) -> Path:
        """Return the file whose name ends so."""
        if self.source is None:
            return self.stem.with_name(self.stem.name + suffix)
        return self.source.output("coefficients", suffix, what_if=self.source.what_if)


def results_of(request: Request) -> list[Given]:
    """Calibrate what is to be calibrated and read what is a result already. Raises `Refused`."""
    names = [name for name in request.sources if isinstance(name, str) and _is_result(Path(name))]
    asked = (request.bench, request.model, request.g_m_s2)
    if names and (any(value is not None for value in asked) or request.skip_bad_rows):
        raise Refused(
            f"{names[0]}: is a result already, made with its own bench file, model and gravity; leave out --bench, "
            "--model, --g and --skip-bad-rows, or give its readings"
        )
    found: list[Given] = []
    for name in request.sources:
        if name in names:
            found += _read(Path(str(name)), request.out)
        else:
            (source,) = load_sources(replace(request, sources=[name]))
            found.append(Given(calibration_of(source).derived, Path(), source))
    files = [given.file("") for given in found]
    for file in repeated(map(str, files)):
        raise Refused(f"--out: two sources would write {file}*; give each a folder of its own")
    return found


def _is_result(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".json" and path.name != MANIFEST


def _read(path: Path, out: Path | None) -> list[Given]:
    try:
        data = from_text(read_regular(path).decode())
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({error.strerror}); check the name") from error
    except ValueError as error:
        raise Refused(f"{path}: not a result of 'bench calibrate --json' ({error})") from error
    results = data if isinstance(data, list) else [data]
    many = len(results) > 1
    stem = (out or path.parent / "coefficients") / path.stem
    return [
        Given(
            block_result(one, f"{path}, result {k}" if many else str(path)),
            stem.with_name(f"{stem.name}-{k}") if many else stem,
            None,
        )
        for k, one in enumerate(results, 1)
    ]


def forms_of(names: list[str]) -> list[str]:
    """Return the forms asked for, each once, in their order; "all" is every one. Raises `Refused`."""
    strange = [name for name in names if name not in FORMS and name != ALL]
    if strange:
        known = ", ".join([*FORMS, ALL])
        raise Refused(f"--as {', '.join(strange)}: the forms are {known}")
    return list(FORMS) if ALL in names else list(dict.fromkeys(names))


def nominal_of(text: str | None, results: list[BlockResult]) -> Floats | None:
    """Return the scale factors (3,) that `--nominal` states, unit/g. Raises `Refused` where they are none.

    They are none of a result whose signals are accelerations, or have other signs.
    """
    if text is None:
        return None
    try:
        values = np.array([read_number(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.all(np.isfinite(values) & (values != 0)):
        raise Refused(
            f"--nominal {text}: three scale factors in unit/g with their signs, such as -2.18,-2.14,-2.14"
        )
    for result in results:
        if result.unit in {"g", "m/s^2"}:
            raise Refused(
                f"--nominal: the signals of {result.source} are in {result.unit} already; leave it out"
            )
        found = np.diag(result.block.K)
        if np.any(found * values < 0):
            raise Refused(
                f"--nominal {text}: {result.source} has scale factors of other signs "
                f"({', '.join(f'{v:.4g}' for v in found)} {result.unit}/g)"
            )
    return values


def write_form(
    result: BlockResult, path: Path, form: str, nominal: tuple[float, float, float] | None
) -> tuple[str, ...]:
    """Write one form to a file; return what it cannot hold. Raises `Refused`, `OSError`."""
    if form not in FORMS:
        raise Refused(f"{form!r}: the forms are {', '.join(FORMS)}")
    chosen = FORMS[form]
    factors = nominal_of(None if nominal is None else ",".join(map(repr, nominal)), [result])
    write_whole(path, chosen.write(result, factors))
    return tuple(chosen.loses(result, factors)) if chosen.loses else ()
