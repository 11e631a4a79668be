"""Option fields that several requests share, and the default folder of runs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bench.base.languages import message
from bench.base.requests import ESTIMATORS_TOLD, Option
from bench.base.text import as_typed
from bench.config.devices import FOLDERS, devices_given

if TYPE_CHECKING:
    from typing import TypeAlias

    import pandas as pd

    from bench.config.bench_file.file import BenchFile
    from bench.readings.table import Readings

    Data: TypeAlias = str | Path | Readings | pd.DataFrame
    """A readings file by path, a run by name or path, or a table in memory."""
    Bench: TypeAlias = str | Path | BenchFile | None
    """A bench file by path or name, or a loaded one; None selects the default as the commands do."""
    Effects: TypeAlias = str | Path | Sequence[str | Path] | None
    """Files with formulas of the user's own effects."""
else:
    # placeholders that avoid slow imports; `bench.services.arguments` maps them to kinds of arguments

    class Data:
        """Readings: by name, or in memory."""

    class Bench:
        """A bench file, by name or loaded."""

    class Effects:
        """Files with effects."""


BenchField = Annotated[
    Bench,
    Option("Bench file, by path or name (default: BENCH_FILE).", metavar="FILE", completes="bench_files"),
]
GravityField = Annotated[
    float | None, Option("Local gravity, m/s², instead of the bench file's.", metavar="M/S2", rare=True)
]
SkipField = Annotated[bool, Option("Skip rows that cannot be read.", rare=True)]
RunsField = Annotated[
    str | Path | None,
    Option("Folder of the runs (default: ./runs).", metavar="DIR", environment="BENCH_RUNS", rare=True),
]
OperatorField = Annotated[
    str,
    Option(message("Name of the operator, for the record."), environment="BENCH_OPERATOR", metavar="NAME"),
]
RunField = Annotated[str, Option("Run, by name or path.", argument=True, completes="runs")]
LatestField = Annotated[
    str | None,
    Option("Run, by name or path (default: the latest unfinished run).", argument=True, completes="runs"),
]
ModelField = Annotated[
    str | Path | None, Option("Model file: effects to add to the paper's model.", rare=True)
]
LimitField = Annotated[float | None, Option("Limit of |Δg| in g, instead of the bench file's.")]
RuleField = Annotated[
    str | None,
    Option(
        "Decision rule: simple, guarded (w = U) or non-binary (default: the bench file's, "
        "else non-binary with 5 % false acceptance).",
        metavar="RULE",
        rare=True,
    ),
]
GuardBandField = Annotated[
    float | None,
    Option(
        "Guard band of the rule: w = R U (default: the bench file's, or the rule's).", metavar="R", rare=True
    ),
]
PopulationField = Annotated[
    tuple[float, float] | None,
    Option(
        "Mean and standard deviation of Δg over many blocks, g, for the risks.", metavar="MEAN SD", rare=True
    ),
]
EstimatorField = Annotated[str, Option(ESTIMATORS_TOLD)]
NominalField = Annotated[bool, Option("Use the target angles instead of those read back.", rare=True)]
JoinFreeField = Annotated[bool, Option("Fit the free positions (F), too, by |a| = 1 g.", rare=True)]
JoinVerificationField = Annotated[
    bool, Option("Fit the verification points, too; they then verify nothing.", rare=True)
]
UntilField = Annotated[
    list[str] | None,
    Option(
        "End the run when a goal is reached: all=5e-5, combined:Kxx=1e-4, delta-g=1e-4, vector=7e-5 or time=4h.",
        metavar="GOALS",
        rare=True,
    ),
]


def runs_folder(runs: str | Path | None) -> Path:
    """Return the folder of runs: `runs` if given, else the one in BENCH_RUNS, else ./runs."""
    return Path(runs or os.environ.get("BENCH_RUNS") or "runs")


def name_to_type(run: Path) -> str:
    """Return a run as a shell takes it: its name if it is in the default folder of runs, else its path."""
    return as_typed(run if runs_to_type(run.parent) else run.name)


def runs_to_type(folder: Path) -> str:
    """Return the option `--runs` of a command that uses this folder of runs, empty if it is the default one."""
    return "" if folder.absolute() == runs_folder(None).absolute() else f" --runs {as_typed(folder)}"


def devices_to_type(run: Path | None = None) -> str:
    """Return the options `--devices` that a command on the same bench needs.

    They name the folders given to this command, and those of the run in folder `run` that are not known here.
    """
    folders = [*devices_given.get(), *(() if run is None else _further_devices(run))]
    return "".join(f" --devices {as_typed(folder)}" for folder in folders)


def _further_devices(run: Path) -> list[Path]:
    """Return the folders from which a run took drivers, if they exist and this command does not search them."""
    from bench.run.events import RecordError, read_manifest  # takes long to import

    try:
        places = [Path(str(place)) for place in read_manifest(run).get("devices", {}).values()]
    except (RecordError, AttributeError):
        return []
    folders = {place.parent.parent if place.name == "__init__.py" else place.parent for place in places}
    searched = {Path(one).expanduser().absolute() for one in os.environ.get(FOLDERS, "").split(os.pathsep)}
    return sorted(one for one in folders - searched if one.is_absolute() and one.is_dir())


def resume_to_type(run: Path) -> str:
    """Return what follows `bench resume` in the command that resumes a run: the run and the options `--devices`."""
    return f"{name_to_type(run)}{devices_to_type(run)}"


@dataclass(frozen=True, kw_only=True)
class OnReadings:
    """The options of every request on readings: bench file, local gravity (m/s²), bad rows, folder of runs."""

    bench: BenchField = None
    g: GravityField = None
    skip_bad_rows: SkipField = False
    runs: RunsField = None
