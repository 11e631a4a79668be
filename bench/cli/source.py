"""What an analysis is made from: a run or a readings file, with the bench and the model that belong to it."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.cli import CommandError
from bench.files.bench.file import BenchFile, load_bench, load_recorded_bench
from bench.files.model import ModelFile, load_model
from bench.files.shipped import find_bench
from bench.model import ForwardModel
from bench.readings.csv import format_csv, read_csv
from bench.readings.table import Readings
from bench.run.folder import BENCH, IMPORTED, Run, find_run
from bench.run.record import MANIFEST, sha256

DEFAULT_BENCH = "paper-stand"
LEAST_GRAVITY, MOST_GRAVITY = 9.75, 9.85


@dataclass(frozen=True)
class Request:
    """Options that all analyses share."""

    sources: list[str]
    runs: Path
    bench: str | None
    model: Path | None
    g_m_s2: float | None
    out: Path | None
    skip_bad_rows: bool


@dataclass(frozen=True)
class Source:
    """One run or readings file, read, with its bench. `run` is None for a readings file."""

    name: str
    readings: Readings
    bench: BenchFile
    bench_sha256: str
    model: ForwardModel
    g_m_s2: float
    run: Run | None
    request: Request

    @property
    def simulated(self) -> bool:
        """Whether the readings come from simulated instruments (a readings file does not say)."""
        return self.run is not None and self.run.simulated

    @property
    def block_name(self) -> str:
        """Type and serial number of the block; empty for a readings file with no bench file of its own."""
        if self.run is None and not (self.request.bench or os.environ.get("BENCH_FILE")):
            return ""
        unit = self.bench.unit_under_test
        return f"{unit.type} {unit.serial}".strip()

    @property
    def made_at(self) -> str | None:
        """Civil time at which the run was begun (ISO 8601); None where nobody recorded it."""
        return self.run.created or None if self.run is not None else None

    @property
    def stand_u(self) -> dict[str, float]:
        """Standard uncertainties of the stand's errors by name, rad (V for the voltmeter's)."""
        return {name: d.u for name, d in self.bench.stand_distributions().items()}

    def output(self, command: str, suffix: str) -> Path:
        """Return the file that a command writes for this source.

        In the run's folder, in `--out`, or in a folder named after the command beside the readings file.
        """
        return _output(self.name, self.run, self.request.out, command, suffix)


def load_sources(request: Request) -> list[Source]:
    """Read all sources. Raises the first mistake found, as the readers do."""
    check_gravity(request.g_m_s2)
    check_places(request)
    return [_load(name, request) for name in request.sources]


def check_places(request: Request) -> None:
    """Refuse sources of which one would write over what another wrote. Raises `CommandError`."""
    if request.out is not None and request.out.exists() and not request.out.is_dir():
        raise CommandError(f"--out {request.out}: a file of that name is there; give a folder")
    places = [_output(name, _run_of(name, request.runs), request.out, "", "") for name in request.sources]
    for place in places:
        if places.count(place) > 1:
            raise CommandError(f"--out: two sources would write {place}*; give each a folder of its own")


def _output(name: str, run: Run | None, out: Path | None, command: str, suffix: str) -> Path:
    if run is not None:
        return out / f"{run.name}-{command}{suffix}" if out else run.folder / f"{command}{suffix}"
    return (out or Path(name).parent / command) / f"{Path(name).stem}{suffix}"


def data_sha256(readings: Readings) -> str:
    """Return the SHA-256 by which a model file knows readings: that of the readings file they make."""
    return sha256(format_csv(readings).encode())


def bench_path(given: str | None) -> Path:
    """Return the bench file asked for (in BENCH_FILE, if not said), or the shipped one that stands in for it."""
    return find_bench(given or os.environ.get("BENCH_FILE") or DEFAULT_BENCH)


def _load(name: str, request: Request) -> Source:
    run = _run_of(name, request.runs)
    notes: tuple[str, ...] = ()
    if run is not None:
        run.trusted_history()
    recorded = run is not None and request.bench is None
    path = run.folder / BENCH if run is not None and recorded else bench_path(request.bench)
    if run is not None and request.bench is not None:
        notes = (f"evaluated with {path} in place of the bench file that the run recorded",)
    bench = load_recorded_bench(path) if recorded else load_bench(path)
    installations = bench.installation_models()
    if run is None:
        readings = read_csv(Path(name), installations, skip_bad_rows=request.skip_bad_rows)
    elif "imported" in run.manifest:
        readings = read_csv(run.folder / IMPORTED, installations, skip_bad_rows=request.skip_bad_rows)
    else:
        readings = run.readings()
    gravity = bench.gravity_m_s2 if request.g_m_s2 is None else request.g_m_s2
    if gravity is None:
        raise CommandError(f"{path}: gives no local gravity; add 'gravity' to it, or say --g 9.81 (m/s²)")
    model = ForwardModel(installations)
    if request.model is not None:
        model, told = _of_model_file(load_model(request.model, installations), readings, model)
        notes += told
    readings = replace(readings, notes=(*notes, *readings.notes))
    return Source(name, readings, bench, sha256(path.read_bytes()), model, gravity, run, request)


def _of_model_file(
    file: ModelFile, readings: Readings, plain: ForwardModel
) -> tuple[ForwardModel, tuple[str, ...]]:
    """Return the model of a file for these readings, with a note where they are what it was found in.

    Its values have then seen the readings: as priors they would count them twice.
    """
    model = replace(plain, effects=file.applied_effects(), name=file.name)
    if data_sha256(readings) not in (file.data_sha256 or "").split():
        return model, ()
    note = f"model {file.name} was found in these very readings: its values are estimated anew, not used as known"
    return replace(model, effects=tuple(replace(a, u={}) for a in model.effects)), (note,)


def _run_of(name: str, runs: Path) -> Run | None:
    """Tell a run from a readings file: a file is a file, everything else must be a run."""
    path = Path(name)
    if path.is_file() and path.name != MANIFEST:
        return None
    if path.suffix.lower() in {".csv", ".txt"} and not (runs / name).is_dir():
        raise CommandError(f"{name}: no such readings file; check the name")
    return find_run(name, runs)


def check_gravity(g_m_s2: float | None) -> None:
    """Refuse a value of local gravity that is none on Earth. Raises `CommandError`."""
    if g_m_s2 is not None and not LEAST_GRAVITY <= g_m_s2 <= MOST_GRAVITY:
        raise CommandError(f"--g {g_m_s2:g}: local gravity lies between 9.75 and 9.85 m/s² on Earth")


def check_target(target: str | None) -> None:
    """Refuse a `--json` file that cannot be written before anything is computed. Raises `CommandError`."""
    if target not in {None, "-"} and not Path(str(target)).absolute().parent.is_dir():
        raise CommandError(f"--json {target}: there is no such folder")


def to_text(result: Any) -> str:
    """Return a result as JSON text."""
    return json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(results: list[dict[str, Any]], target: str | None) -> None:
    """Write one result, or a list of several in the order of the sources, to a file or standard output."""
    if target is None:
        return
    text = to_text(results[0] if len(results) == 1 else results)
    if target == "-":
        sys.stdout.write(text)
    else:
        write_whole(Path(target), text)


def write_whole(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all. Raises `OSError` that names it."""
    half = path.with_name(path.name + ".part")
    try:
        half.write_text(text, encoding="utf-8", newline="")
        half.replace(path)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_beside(path: Path, text: str, *, asked: bool) -> bool:
    """Write a derived file; say so and go on where the place is not writable, unless it was asked for."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
    except OSError as error:
        if asked:
            raise
        print(f"note: {os.fspath(path)} is not written ({error.strerror}); use --out DIR", file=sys.stderr)
        return False
    return True
