"""The job that a batch does for each run, and the columns of the resulting table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

from bench.base.arrays import CHANNELS
from bench.base.computing import versions
from bench.calibration.estimators import GLS, find_estimator
from bench.config.bench_file.file import load_bench
from bench.config.formulas import files_of_environment
from bench.config.shipped import find_bench
from bench.model.geometry import COEFFICIENTS
from bench.run.events import sha256
from bench.services.errors import Refused
from bench.services.requests.documents import Batch, BatchCalibrate, BatchDiagnose, BatchReport
from bench.services.source import Request, check_gravity
from bench.services.verification import VerdictOptions

CALIBRATE: Final = "calibrate"
DIAGNOSE: Final = "diagnose"
REPORT: Final = "report"
_COMMANDS: Final = {BatchCalibrate: CALIBRATE, BatchDiagnose: DIAGNOSE, BatchReport: REPORT}

PAGES: Final = "pages"
"""The folder of pages in the folder of a batch."""


@dataclass(frozen=True)
class Job:
    """One command with its options, for any number of runs; files are named by absolute paths.

    `command` is calibrate, diagnose or report; `pages` is the folder for the pages of `report`. The other
    fields are options of these commands.
    """

    command: str
    estimator: str = GLS
    nominal_angles: bool = False
    join_free: bool = True
    join_verification: bool = False
    bench: str | None = None
    model: str | None = None
    g_m_s2: float | None = None
    skip_bad_rows: bool = False
    limit_g: float | None = None
    rule: str | None = None
    guard_band: float | None = None
    population: tuple[float, float] | None = None
    effects: tuple[str, ...] = ()
    pages: str = ""

    def request(self, run: str) -> Request:
        """Return the request that evaluates the run in the folder `run`."""
        model = None if self.model is None else Path(self.model)
        return Request([run], Path(run).parent, self.bench, model, self.g_m_s2, None, self.skip_bad_rows)

    def asked(self) -> VerdictOptions:
        """Return the verdict options of the job, which replace those recorded in each run."""
        return VerdictOptions(self.limit_g, self.rule, self.guard_band, self.population)

    def checked(self) -> Job:
        """Return the job with absolute paths. Raises the command's error for an unusable option."""
        estimator = find_estimator(self.estimator).name
        check_gravity(self.g_m_s2)
        self.asked().check()
        bench = self.bench
        if bench is not None:
            load_bench(find_bench(bench))
            bench = str(find_bench(bench).absolute())
        if self.model is not None and not Path(self.model).is_file():
            raise Refused(f"--model {self.model}: no such file; check the name")
        model = None if self.model is None else str(Path(self.model).absolute())
        effects = tuple(str(Path(file).absolute()) for file in self.effects)
        return replace(self, estimator=estimator, bench=bench, model=model, effects=effects)

    def differing(self) -> dict[str, Any]:
        """Return the options that differ from their defaults."""
        usual = Job(self.command, pages=self.pages).to_json()
        return {name: value for name, value in self.to_json().items() if value != usual[name]}

    def to_json(self) -> dict[str, Any]:
        """Return the job as JSON for the batch file: its options, and the SHA-256 of each named file."""
        given = asdict(self)
        given["population"] = None if self.population is None else list(self.population)
        given["effects"] = [_named(file) for file in self.effects]
        return given | {name: _named(given[name]) for name in ("bench", "model") if given[name]}


def job_of(request: Batch) -> Job:
    """Return the job of a request, with the effects files that BENCH_EFFECTS lists."""
    other_names = {"g": "g_m_s2", "limit": "limit_g"}
    given = {other_names.get(one.name, one.name): getattr(request, one.name) for one in fields(request)}
    mine = {one.name: given[one.name] for one in fields(Job) if one.name in given}
    return Job(
        **mine
        | {
            "command": _COMMANDS[type(request)],
            "model": None if request.model is None else str(request.model),
            "effects": tuple(files_of_environment()),
            "pages": str((request.out / PAGES).absolute()) if isinstance(request, BatchReport) else "",
        }
    )


def _named(file: str) -> dict[str, str]:
    return {"file": file, "sha256": sha256(Path(file).read_bytes())}


@cache
def program() -> Mapping[str, str]:
    """Return the versions of this program, Python, NumPy and SciPy, and a hash of the program's code."""
    package = Path(__file__).parents[1]
    files = sorted(package.rglob("*.py"))
    told = "".join(f"{file.relative_to(package).as_posix()} {sha256(file.read_bytes())}\n" for file in files)
    known = versions()
    return {
        "version": known["triaxial-bench"],
        **{name: known[name] for name in ("python", "numpy", "scipy")},
        "code": sha256(told.encode())[:16],
    }


TEXT, NUMBER, WHOLE, FLAG, NUMBERS = "string", "float64", "int64", "bool", "numbers"
"""The kinds of columns, by their Arrow names; `NUMBERS` is a list of numbers."""

OF_METERS: Final = tuple(f"{what}_{channel}" for channel in CHANNELS for what in ("gain", "offset_v"))
"""Columns of a record at a known input: gain and offset of each channel's meter."""

_COMMON: Final = {
    **dict.fromkeys(("run", "name", "unit_type", "serial", "bench"), TEXT), "simulated": FLAG,
    **dict.fromkeys(("begun", "measured_with", "failed", "verdict_stored", "verdict"), TEXT),
    "verdict_differs": FLAG,
}  # fmt: skip
_CALIBRATION: Final = {
    **{f"{name}{of}": TEXT for name in ("estimator", "model", "signal_unit") for of in ("_stored", "")},
    **{f"g{of}_m_s2": NUMBER for of in ("_stored", "")},
    **{
        f"{name}{of}": NUMBER
        for name in ("worst_delta_g", "worst_delta_g_u", "limit_g")
        for of in ("_stored", "")
    },
    "rule_stored": TEXT, "rule": TEXT, "fit_stored": TEXT, "fit": TEXT, "fit_differs": FLAG, "p_stored": NUMBER,
    "p": NUMBER, "readings_used": WHOLE, "largest_change_in_u": NUMBER, "largest_change_of": TEXT,
    "least_u_ratio": NUMBER, "most_u_ratio": NUMBER,
    **{
        column: NUMBER
        for name in COEFFICIENTS
        for column in (f"{name}_stored", name, f"u_{name}_stored", f"u_{name}", f"{name}_change_in_u")
    },
    "covariance": NUMBERS,
    **{
        column: NUMBER
        for name in OF_METERS
        for column in (f"{name}_stored", name, f"u_{name}_stored", f"u_{name}", f"{name}_change_in_u")
    },
}  # fmt: skip
_DIAGNOSIS: Final = {
    "model": TEXT, "names_stored": TEXT, "names": TEXT, "names_differ": FLAG, "gap_before_stored": NUMBER,
    "gap_before": NUMBER, "gap_after_stored": NUMBER, "gap_after": NUMBER, "result": TEXT,
}  # fmt: skip
_AT_THE_END: Final = {"notes": TEXT, "fingerprint": TEXT}

COLUMNS: Final = {
    CALIBRATE: {**_COMMON, **_CALIBRATION, **_AT_THE_END},
    REPORT: {**_COMMON, **_CALIBRATION, "page": TEXT, **_AT_THE_END},
    DIAGNOSE: {**_COMMON, **_DIAGNOSIS, **_AT_THE_END},
}
"""For each command, all columns of its table with the meaning of each."""

NOT_IN_TEXT: Final = ("covariance", "result", "fingerprint")
"""Columns that the text form of the table omits."""

Row = dict[str, Any]
"""The row of one run: values by column of its command. A missing column means an unknown value."""


def arrow_schema(command: str) -> Any:
    """Return the Arrow schema of the table of a command."""
    import pyarrow as arrow

    numbers = arrow.list_(arrow.float64())
    columns = COLUMNS[command].items()
    return arrow.schema(
        [(name, numbers if kind == NUMBERS else arrow.type_for_alias(kind)) for name, kind in columns]
    )
