"""Faults that `bench validate` must find: lines of the program edited in memory, unfit machines and files.

    with FAULTS[0].plant(context) as spoilt:
        rows = carry_out(spoilt, every())

An edit replaces text in the source of one function, and the function by the compiled result. `place` is a pattern
that must occur in a failed check: in its name, its place or its finding.
"""

import contextlib
import copy
import importlib
import inspect
import os
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Final
from unittest import mock

import yaml

from bench.model.geometry import INSTALLATION_2
from bench.validation import machine, reference, registry
from bench.validation.registry import Context


@dataclass(frozen=True)
class PlantedFault:
    """A fault by name: the pattern of its place, the family that should find it, and how it is planted.

    `plant(context)` is a context manager, which yields the context to validate in; `kind` names its function.
    """

    name: str
    place: str
    family: str
    plant: Callable[[Context], AbstractContextManager[Context]]
    kind: str


def of_kind(plant: Callable[..., Iterator[Context]]) -> Callable[..., PlantedFault]:
    """Return a function that makes faults of one kind; `plant(context, …)` yields the context to validate."""

    def made(name: str, place: str, family: str, *given: Any, **options: Any) -> PlantedFault:
        return PlantedFault(
            name, place, family,
            lambda context: contextlib.contextmanager(plant)(context, *given, **options), plant.__name__,
        )  # fmt: skip

    return made


# --- edits of the program ---------------------------------------------------------------------------


def function_at(target: str) -> Any:
    """Return the function at "module:name" or "module:Class.name"."""
    module, _, path = target.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = inspect.getattr_static(found, part) if inspect.isclass(found) else getattr(found, part)
    found = getattr(found, "fget", None) or found
    return getattr(found, "__wrapped__", found)


@contextlib.contextmanager
def edited(target: str, old: str, new: str) -> Iterator[None]:
    """Replace text in the source of a function. Raises `ValueError` if the text is not there."""
    function = function_at(target)
    source = textwrap.dedent(inspect.getsource(function))
    if old not in source:
        raise ValueError(f"{target}: its source does not have {old!r}")
    head = source.index("def ")
    space: dict[str, Any] = {}
    text = "from __future__ import annotations\n" + source[head:].replace(old, new, 1)
    exec(compile(text, f"<{target}, edited>", "exec"), function.__globals__, space)  # noqa: S102 - our own source
    before = function.__code__
    function.__code__ = next(iter(one for one in space.values() if inspect.isfunction(one))).__code__
    try:
        yield
    finally:
        function.__code__ = before


@of_kind
def edit(context: Context, target: str, old: str, new: str) -> Iterator[Context]:
    """Yield a context in which a line of the program is edited."""
    with edited(target, old, new):
        yield context


@of_kind
def patch(context: Context, *given: Any, **options: Any) -> Iterator[Context]:
    """Yield a context with a replaced attribute; the arguments are those of `unittest.mock.patch.object`."""
    with mock.patch.object(*given, **options):
        yield context


@of_kind
def environment(context: Context, variable: str, value: str) -> Iterator[Context]:
    """Yield a context with another value of an environment variable."""
    with mock.patch.dict(os.environ, {variable: value}):
        time.tzset()
        yield context
    time.tzset()


# --- files ------------------------------------------------------------------------------------------


@of_kind
def bench_edit(context: Context, change: Callable[[dict[str, Any]], None]) -> Iterator[Context]:
    """Yield a context with an edited bench file."""
    data = yaml.safe_load(context.bench_path.read_text(encoding="utf-8"))
    change(data)
    path = context.scratch / context.bench_path.name
    path.write_text(yaml.safe_dump(data, allow_unicode=True, sort_keys=False), encoding="utf-8")
    yield replace(context, bench_path=path, shared={})


@of_kind
def accepted_edit(context: Context, change: Callable[[dict[str, Any]], None]) -> Iterator[Context]:
    """Yield a context in which the accepted result is changed, as if the installation had changed since."""
    before = copy.deepcopy(context.accepted or {})
    change(before)
    yield replace(context, accepted=before)


@of_kind
def data_edit(context: Context, file: str, old: str, new: str) -> Iterator[Context]:
    """Yield a context with a damaged file of reference data."""
    folder = context.scratch / "data"
    shutil.copytree(registry.REFERENCE, folder)
    text = (folder / file).read_text(encoding="utf-8")
    if old not in text:
        raise ValueError(f"{file} does not have {old!r}")
    (folder / file).write_text(text.replace(old, new, 1), encoding="utf-8")
    with mock.patch.object(reference, "REFERENCE", folder):
        yield context


@of_kind
def package_edit(context: Context, package: str, change: Callable[[Path, Path], object]) -> Iterator[Context]:
    """Yield a context with a changed copy of an installed package; `change(root, dist-info)` changes it."""
    root = context.scratch / "site"
    one = metadata.distribution(package)
    for file in one.files or ():
        there = Path(str(one.locate_file(file)))
        if there.is_file() and ".." not in Path(file).parts:
            (root / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(there, root / file)
    change(root, next(root.glob("*.dist-info")))
    with mock.patch.object(sys, "path", [str(root), *sys.path]):
        yield context


@of_kind
def folder_fault(context: Context, make: Callable[[Path], Path]) -> Iterator[Context]:
    """Yield a context with the folder of runs that `make(scratch)` returns."""
    yield replace(context, folders=(make(context.scratch),))


def _future_record(scratch: Path) -> Path:
    folder = scratch / "old-runs" / "run"
    folder.mkdir(parents=True)
    file = folder / "events.jsonl"
    file.write_bytes(b"")
    os.utime(file, (time.time() + 86400.0, time.time() + 86400.0))
    return folder.parent


def _open_folder(scratch: Path) -> Path:
    folder = scratch / "open-runs"
    folder.mkdir()
    folder.chmod(0o777)
    return folder


def _appended(root: Path, info: Path) -> None:
    file = next(root.glob("h11/*.py"))
    file.write_text(file.read_text(encoding="utf-8") + "\n", encoding="utf-8")


def _version_99(root: Path, info: Path) -> None:
    text = (info / "METADATA").read_text(encoding="utf-8")
    (info / "METADATA").write_text(re.sub(r"(?m)^Version: .*$", "Version: 99.0", text), encoding="utf-8")


def _set(*keys: Any) -> Callable[[dict[str, Any]], None]:
    """Return a function that sets a member of nested data; `keys` are its keys, followed by the value."""
    *path, last, value = keys

    def change(data: dict[str, Any]) -> None:
        for key in path:
            data = data[key]
        data[last] = value

    return change


class _NoLock:
    def __init__(self, *_: Any, **__: Any) -> None: ...

    def __enter__(self) -> None: ...

    def __exit__(self, *_: Any) -> None: ...


@of_kind
def wrong_installation(context: Context) -> Iterator[Context]:
    """Yield a context in which installation 2 is its mirror image."""
    before = INSTALLATION_2.block_from_platform
    object.__setattr__(INSTALLATION_2, "block_from_platform", before * [[-1.0], [1.0], [1.0]])
    try:
        yield context
    finally:
        object.__setattr__(INSTALLATION_2, "block_from_platform", before)


REF, STAT, WIRE, MACHINES, OUT = "reference data", "statistics", "instruments", "machine", "results given out"
GEOMETRY: Final = "bench.model.geometry"
PROPAGATION: Final = "bench.calibration.budget.propagation"
CHARTS: Final = "bench.stats.control_charts"
SCPI: Final = "drivers.scpi_voltmeter:ScpiVoltmeter"
METER: Final = "drivers.instruments.agilent_34401a:Agilent34401A._setup"

ARITHMETIC: Final = (
    edit("solver off by 1e-6", "gls", REF, "bench.calibration.gls:solve_rows", "inverse @ (q.T @ target)",
         "(1.0 + 1e-6) * (inverse @ (q.T @ target))"),
    edit("covariance of the solver off by 1e-6", "gls", REF, "bench.calibration.gls:solve_rows",
         "inverse @ inverse.T", "(1.0 + 1e-6) * (inverse @ inverse.T)"),
    edit("start values off by 1e-6", "least_squares", REF, "bench.base.arrays:least_squares",
         "np.asarray(solution),", "(1.0 + 1e-6) * np.asarray(solution),"),
    edit("sign of the sine", "geometry", REF, f"{GEOMETRY}:specific_force_on_platform", "= sin * cos_tilt",
         "= -sin * cos_tilt"),
    edit("sine for cosine", "geometry", REF, f"{GEOMETRY}:specific_force_on_platform", ", cos * cos_tilt",
         ", sin * cos_tilt"),
    edit("sign of the bias", "geometry", REF, f"{GEOMETRY}:Block.output", "+ self.U0", "- self.U0"),
    edit("sign of the bias, inverse", "accelerometers|free", REF, f"{GEOMETRY}:Block.specific_force",
         "signal_v - self.U0", "signal_v + self.U0"),
    edit("K transposed", "geometry", REF, f"{GEOMETRY}:Block.output", "self.K.T", "self.K"),
    wrong_installation("installation 2 mirrored", "geometry", REF),
    edit("g off by 50 mGal", "gravity", REF, f"{GEOMETRY}:normal_gravity_m_s2", "_EQUATOR_M_S2 * (1",
         "(_EQUATOR_M_S2 + 5e-4) * (1"),
    edit("one-sided coverage factor", "propagation", REF, f"{PROPAGATION}:coverage_factor",
         "0.5 * (1.0 + probability)", "probability"),
    edit("Welch-Satterthwaite without the square", "propagation", REF, f"{PROPAGATION}:effective_dof",
         "total**2", "total"),
    edit("rectangle of half-width u", "propagation", REF, f"{PROPAGATION}:drawn",
         "-distribution.limit, distribution.limit", "-distribution.u, distribution.u"),
    edit("normal for t", "propagation", REF, f"{PROPAGATION}:drawn", "rng.standard_t(dof, shape)",
         "rng.standard_normal(shape)"),
    edit("interval not in the middle", "propagation", REF, f"{PROPAGATION}:summary", "(trials - inside) // 2",
         "(trials - inside) // 5"),
    edit("tolerance of one digit less", "propagation", REF, f"{PROPAGATION}:numerical_tolerance", "- digits + 1",
         "- digits + 2"),
    edit("clause 8 always content", "propagation", REF, f"{PROPAGATION}:validate",
         "linear.expanded(trials.probability)", "trials.symmetric.T[1] - linear.value"),
    edit("sign of correlations", "propagation", REF, f"{PROPAGATION}:correlation_of", "covariance / np.outer",
         "-covariance / np.outer"),
    edit("deviations of a chart doubled", "control_charts", REF, f"{CHARTS}:judge", "z = deviation / u",
         "z = 2.0 * deviation / u"),
    edit("sign in the kernel of a chart", "ewma", REF, f"{CHARTS}:ewma_arl", "(places - (1.0",
         "(places + (0.7"),
    edit("chart centred on the first run", "control_charts", REF, f"{CHARTS}:centre_of",
         "values.mean(axis=-2)", "values[..., 0, :]"),
    edit("closed form off by 1e-6", "closed-form", REF, "bench.calibration.closed_form:closed_form",
         "(2 * (1 + root2))", "(2 * (1 + root2) * (1 + 1e-6))"),
    edit("scale without g", "free", REF, "bench.calibration.free:triangular", "g_m_s2 * scale", "scale"),
    edit("modulus off by 100 ppm", "free|accelerometers", REF, "bench.calibration.free:_moduli",
         "1.0 - np.linalg.norm", "1.0001 - np.linalg.norm"),
    edit("u halved", "bench/calibration", STAT, "bench.calibration.calibrate:solve",
         "birge**2 * fit.covariance", "birge**2 * 0.25 * fit.covariance"),
    edit("u doubled", "bench/calibration", STAT, "bench.calibration.calibrate:solve",
         "birge**2 * fit.covariance", "birge**2 * 4.0 * fit.covariance"),
    edit("lack of fit one and a half times too large", "lack of fit", STAT, "bench.calibration.gls:misfit_test",
         "chi2 / dof))", "1.5 * chi2 / dof))"),
    edit("x and y exchanged in files", "accelerometers|readings", REF, "bench.readings.csv:_read",
         'for axis in "xyz"]', 'for axis in "yxz"]'),
)  # fmt: skip

INSTRUMENTS: Final = (
    edit("sign of a reading", "simulated bench|voltmeter", "records", f"{SCPI}.fetch", "map(float, texts)",
         "(-float(text) for text in texts)"),
    edit("gain of a reading off by 0.1 %", "simulated bench|voltmeter", "records", f"{SCPI}.fetch",
         "map(float, texts)", "(1.001 * float(text) for text in texts)"),
    edit("another instrument accepted", "voltmeter", WIRE, f"{SCPI}._accept", "identity.model in self.models and",
         "True or"),
    edit("settings not read back", "voltmeter", WIRE, f"{SCPI}._set",
         "return [] if taken", "return [] if True"),
    edit("overload taken for a number", "voltmeter", WIRE, f"{SCPI}._refuse_overload", "if over:", "if False:"),
    edit("errors of the meter not read", "voltmeter|settings", WIRE, f"{SCPI}.configure",
         "self._refuse(troubles,", "self._refuse([],"),
    edit("dialect: a command that there is not", "voltmeter", WIRE, METER, "VOLT:DC:NPLC {", "VOLT:DC:PLC {"),
    edit("dialect: a range too high", "voltmeter", WIRE, METER, "CONF:VOLT:DC {settings.range_v",
         "CONF:VOLT:DC {10.0 * settings.range_v"),
    edit("dialect: trigger from the bus", "voltmeter", WIRE, METER, "TRIG:SOUR IMM", "TRIG:SOUR BUS"),
    edit("dialect: a sample too many", "voltmeter", WIRE, METER, "SAMP:COUN {settings.samples}",
         "SAMP:COUN {settings.samples + 1}"),
    patch("dialect: start", "voltmeter", WIRE, importlib.import_module("drivers.scpi_voltmeter").ScpiVoltmeter,
          "start_command", "INITT"),
    patch("dialect: fetch", "voltmeter", WIRE, importlib.import_module("drivers.scpi_voltmeter").ScpiVoltmeter,
          "fetch_query", "FETCH!?"),
    edit("dialect: readings of the meter", "voltmeter", WIRE, "sim.agilent_34401a:Trigger._sampled",
         "return reading_text(", 'return "V" + reading_text('),
    edit("sign of the head's scale", "simulated bench|head", "records",
         "drivers.instruments.manual:ManualHead._turned", "HeadPosition(angle_rad", "HeadPosition(-angle_rad"),
    edit("garbled replies accepted", "voltmeter", WIRE, "drivers.wire.visa:MessageSession.query",
         "reply) is not None", "reply) != 1"),
)  # fmt: skip

OUTPUTS: Final = (
    edit("sign of U in a certificate", "certificate", "certificates", "bench.certificate.gather:_values",
         "k * row.u", "-k * row.u"),
    edit("names exchanged in a DCC", "certificate", "certificates", "bench.certificate.dcc.document:_listed",
         "[one.name for one in members],",
         '[{"Kxy": "Kyx", "Kyx": "Kxy"}.get(one.name, one.name) for one in members],'),
    edit("a wrong unit in an export", "exports", OUT, "bench.exchange.forms:csv_text", "row.unit])",
         '"m" + row.unit])'),
    edit("a two-sided quantile for the guard band", "conformity", OUT, "bench.calibration.conformity:_quantile",
         "special.ndtri(level)", "special.ndtri(0.5 * (1.0 + level))"),
    edit("scale of an autopilot not inverted", "exports", OUT, "bench.exchange.autopilots:diagonal",
         "1.0 / np.diag(sensor.M)", "np.diag(sensor.M)"),
)  # fmt: skip

RECORDS: Final = (
    edit("chain of a record not checked", "record", "records", "bench.run.record:_Reader._take",
         "previous != history.head or", "False or"),
    edit("inputs of a record not checked", "record", "records", "bench.run.events:changed_inputs",
         "sha256(read_regular(folder / name)) != digest", "False"),
    edit("inputs hashed wrongly", "record|run", "records", "bench.run.record:Record.create",
         "sha256(content) for", 'sha256(b"") for'),
    edit("chain of a register not checked", "register", "certificates", "bench.services.chain:Chain._take",
         "previous != self.head or", "False or"),
    edit("revocation not written", "certificate", "certificates", "bench.certificate.life:revoke",
         "register.append(", "str("),
    edit("revocation written and not heeded", "certificate", "certificates",
         "bench.certificate.register:Register._note", "standing.entry, REVOKED", "standing.entry, ISSUED"),
)  # fmt: skip

MACHINE: Final = (
    environment("a zone that there is not", "TZ|time zone", MACHINES, "TZ", "Europe/Kiyv"),
    environment("another zone than accepted", "time zone", "changes", "TZ", "Asia/Tokyo"),
    environment("a locale that there is not", "locale|LC_ALL", MACHINES, "LC_ALL", "xx_XX.UTF-8"),
    patch("clock of 2020", "clock", MACHINES, machine, "utc_now", lambda: datetime(2020, 1, 1, tzinfo=UTC)),
    patch("clock that is set while it runs", "clock", MACHINES, time, "time",
          iter([float(k) for k in range(1_700_000_000, 1_700_100_000, 7)]).__next__),
    folder_fault("a record from the future", "clock", MACHINES, _future_record),
    folder_fault("read-only disk", "disk", MACHINES, lambda scratch: Path("/proc")),
    folder_fault("folder that everybody may write", "permissions", MACHINES, _open_folder),
    patch("full disk", "disk", MACHINES, shutil, "disk_usage", lambda _: mock.Mock(free=1e6)),
    patch("locks that do not lock", "lock|disk", MACHINES, importlib.import_module("filelock"), "FileLock",
          _NoLock),
    patch("disk that refuses to flush", "disk", MACHINES, os, "fsync",
          mock.Mock(side_effect=OSError(5, "Input/output error"))),
    patch("names of files in ASCII", "locale|names", MACHINES, sys, "getfilesystemencoding", lambda: "ascii"),
    package_edit("a changed file of a package", "h11", MACHINES, "h11", _appended),
    package_edit("a missing file of a package", "h11", MACHINES, "h11",
                 lambda root, info: next(root.glob("h11/_*.py")).unlink()),
    package_edit("a package beyond its bounds", "filelock", MACHINES, "filelock", _version_99),
    package_edit("a package without its list of files", "h11", MACHINES, "h11",
                 lambda root, info: (info / "RECORD").write_text("")),
    accepted_edit("a changed file of the program", "gls.py", "changes",
                  _set("program", "files", "bench/calibration/gls.py", "0" * 64)),
    accepted_edit("a new file in the program", "gum.py", "changes",
                  lambda one: one["program"]["files"].pop("bench/validation/gum.py")),
    accepted_edit("another package", "numpy", "changes", _set("program", "packages", "numpy", "version", "1.0")),
    accepted_edit("another Python", "python", "changes", _set("program", "python", "CPython 3.9.1")),
    accepted_edit("another locale", "locale", "changes", _set("machine", "locale", "de_DE.UTF-8")),
    bench_edit("a changed bench file", "bench file", "changes", _set("verification", "limit", "1e-3 g")),
    bench_edit("a bench file with an unknown key", "colour", WIRE, _set("colour", "blue")),
    bench_edit("a bench file of another driver", "agilent-34402", WIRE,
               lambda data: data["instruments"]["voltmeters"][0].update(driver="agilent-34402")),
    bench_edit("wrong g in the bench file", "gravity", REF, _set("gravity", "9.18 m/s^2")),
    data_edit("a damaged regression", "strd", REF, "strd.json", "-6.860120914", "-6.860120941"),
    data_edit("a damaged check standard", "kilogram", REF, "kilogram-check.csv", "\n1975", "\n1986"),
    data_edit("a damaged set of an accelerometer", "accelerometers", REF, "innalabs-24.csv", "0.99", "0.98"),
)  # fmt: skip

FAULTS: Final = (*ARITHMETIC, *INSTRUMENTS, *OUTPUTS, *RECORDS, *MACHINE)
