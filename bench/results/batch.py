"""The result of `bench batch`, which compares new verdicts and coefficients with the stored ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from pydantic import Field
from rich.console import Console

from bench.base.languages import message
from bench.base.result_model import ResultModel
from bench.base.tables import table

_ON_SCREEN: Final = 20
"""Largest number of runs that a terminal lists; the tables of the batch list all."""


class FileAsked(ResultModel):
    """A file named in an option of `bench batch`."""

    file: str
    sha256: str


class ProgramPart(ResultModel):
    """The versions of program, Python and packages that computed the new results."""

    version: str
    python: str
    numpy: str
    scipy: str
    code: str = Field(description="first digits of the SHA-256 of the program's code")


class RunsPart(ResultModel):
    """The numbers of runs in the batch."""

    listed: int = Field(description="number of runs that the patterns or the query match")
    done: int = Field(description="number of runs that have a row in the table")
    failed: int = Field(description="number of runs without a result; their row states the reason")
    computed: int = Field(description="number of runs with a result: `done` minus `failed`")
    simulated: int = Field(description="runs on simulated instruments")
    without_stored_verdict: int = Field(description="computed runs whose folder has no verdict")


class Counted(ResultModel):
    """How many runs have a new result that differs from the stored one, equals it, or cannot be compared."""

    different: int = Field(description="number of runs whose new value differs from the stored one")
    same: int = Field(description="number of runs whose new value equals the stored one")
    unknown: int = Field(description="number of computed runs without a stored value or without a new one")


class VerdictChange(ResultModel):
    """The number of runs with the same stored verdict and the same new verdict."""

    stored: str
    now: str
    simulated: bool | None
    runs: int


class VerdictsPart(Counted):
    """How many runs have a new verdict that differs from the stored one, equals it, or cannot be compared."""

    changes: list[VerdictChange] = Field(description="number of runs for each pair of stored and new verdict")


class ChangeInU(ResultModel):
    """The largest coefficient change of each run, in units of stored u: median, 95 % quantile, maximum."""

    median: float
    of_95_percent: float
    most: float
    most_of: str = Field(description="path of the run with the largest change")
    most_in: str = Field(description="the coefficient with the largest change")


class RatioPart(ResultModel):
    """The range of the ratio of the new u to the stored u."""

    least: float
    most: float


class _Different(ResultModel):
    run: str = Field(description="path of the run folder")
    unit_type: str | None
    serial: str | None
    simulated: bool | None
    stored: str = Field(description="verdict in the run's folder")
    now: str = Field(description="verdict computed by this batch")


class DifferentVerdict(_Different):
    """A run whose new verdict differs from the stored one."""

    worst_delta_g_stored: float | None = Field(description="stored Δg with the largest size, g")
    worst_delta_g: float | None = Field(description="Δg with the largest size computed by this batch, g")
    largest_change_in_u: float | None
    largest_change_of: str | None

    def cells(self) -> list[str]:
        """Return the row's cells after its two verdicts: stored Δg, new Δg, largest coefficient change."""
        sizes = (self.worst_delta_g_stored, self.worst_delta_g)
        change = self.largest_change_in_u
        went = "" if change is None else f"{change:.2g} u in {self.largest_change_of}" if change else "none"
        return [*("" if size is None else f"{size * 1e6:+.1f} µg" for size in sizes), went]


class DifferentNames(_Different):
    """A run in which the new diagnosis names other effects than the stored diagnosis."""

    names_stored: str
    names: str

    def cells(self) -> list[str]:
        """Return the row's cells after its two verdicts: effects named before, and effects named now."""
        return [self.names_stored, self.names]


class FailedRun(ResultModel):
    """A run that could not be evaluated, and the reason."""

    run: str
    why: str


class MeasuredWith(ResultModel):
    """The number of runs that were measured with one version of the program."""

    version: str | None
    runs: int


Asked = bool | int | float | str | FileAsked | list[float] | list[FileAsked] | None


class BatchResult(ResultModel):
    """The results of many runs computed again: `bench batch … --json`, and `summary.json` in its folder."""

    command: Literal["calibrate", "diagnose", "report"]
    over: list[str] = Field(description="patterns of run folders, or the words of a query of the catalogue")
    asked: dict[str, Asked] = Field(description="options other than their defaults; files with their SHA-256")
    program: ProgramPart
    begun: str = Field(description="civil time at which the batch began (ISO 8601)")
    runs: RunsPart
    verdicts: VerdictsPart
    names: Counted | None = Field(description="changes in the names of effects; only for `diagnose`")
    fit: Counted | None
    """changes in whether the model fits the readings (p of the lack-of-fit test of 0.01 or more)"""
    change_in_u: ChangeInU | None
    u_ratio: RatioPart | None = Field(description="new u divided by stored u, over all coefficients and runs")
    different: list[DifferentVerdict | DifferentNames]
    """the first 1000 runs whose verdict differs (for `diagnose`, whose verdict or names differ); verdicts.csv
    lists all
    """
    failed: list[FailedRun] = Field(description="the first 1000 runs without a result; failed.csv lists all")
    measured_with: list[MeasuredWith]
    files: list[str] = Field(description="tables written to the batch's folder")

    def accepted(self, *, strict: bool = False) -> bool:
        """Return whether no verdict differs and no run failed.

        With `strict`, the lack-of-fit decisions and the names of effects must not differ, either.
        """
        more = (self.fit or self.names) if strict else None
        return not (self.verdicts.different or self.runs.failed or (more and more.different))

    def print_on(self, out: Console, folder: Path) -> None:
        """Print the verdicts that differ, the changes of the coefficients, and the paths of the tables."""
        self._print_runs(out)
        self._print_verdicts(out)
        if self.different:
            self._print_different(out)
        if self.change_in_u:
            self._print_coefficients(self.change_in_u, out)
        for one in self.failed[:_ON_SCREEN]:
            out.print(f"failed: {_short(one.run)}: {one.why}")
        _print_more(self.failed, "failed.csv", out)
        for name in (*self.files, "summary.json"):
            out.print(f"  {folder / name}")
        differ, failed = self.verdicts.different, self.runs.failed
        said = (
            f"{_count(differ, 'VERDICT')} WOULD BE DIFFERENT" if differ else "NO VERDICT WOULD BE DIFFERENT"
        )
        out.print(said + (f"; {_count(failed, 'RUN')} FAILED" if failed else ""), style="bold")

    def _print_runs(self, out: Console) -> None:
        runs, program = self.runs, self.program
        kinds = [f"{runs.simulated:,} simulated"] if runs.simulated else []
        if left := runs.listed - runs.done:
            kinds.append(message(f"{left:,} not done yet"))
        said = f" ({', '.join(kinds)})" if kinds else ""
        out.print(
            f"batch {self.command} over {' '.join(self.over)}: {_count(runs.listed, 'run')}{said}, "
            f"program {program.version} (code {program.code})"
        )
        versions = {str(one.version or "not recorded"): one.runs for one in self.measured_with}
        if versions.keys() - {program.version}:
            listed = ", ".join(f"{version} ({count:,})" for version, count in versions.items())
            out.print(f"the runs were measured with program {listed}")
        words = [f"{name.replace('_', ' ')} {_option(value)}" for name, value in self.asked.items()]
        how = ", ".join(words) or message("what each run recorded")
        out.print(f"computed with: {how}")

    def _print_verdicts(self, out: Console) -> None:
        found = self.verdicts
        out.print(
            f"verdicts: {found.same:,} the same, {found.different:,} different, {found.unknown:,} with nothing to "
            f"compare ({self.runs.without_stored_verdict:,} without a stored one)"
        )
        for judged, what in ((self.fit, "lack of fit"), (self.names, "names of effects")):
            if judged:
                out.print(f"{what}: {judged.same:,} judged the same, {judged.different:,} otherwise")
        if found.changes:
            shown = table("stored", "now", ">runs", "")
            for one in found.changes:
                shown.add_row(one.stored, one.now, f"{one.runs:,}", "simulated" if one.simulated else "")
            out.print(shown)

    def _print_different(self, out: Console) -> None:
        own = (
            (">worst Δg stored", ">now", ">most change")
            if self.names is None
            else ("names stored", "names now")
        )
        shown = table("would be different", "unit", "stored", "now", *own)
        for one in self.different[:_ON_SCREEN]:
            shown.add_row(_short(one.run), one.serial or "", one.stored, one.now, *one.cells())
        out.print(shown)
        _print_more(self.different, "verdicts.csv", out)

    def _print_coefficients(self, change: ChangeInU, out: Console) -> None:
        if change.most == 0.0:
            out.print("no coefficient has changed")
            return
        out.print(
            f"largest change of a coefficient in a run, in units of its stored u: median {change.median:.2g}, "
            f"95 % up to {change.of_95_percent:.2g}, most {change.most:.2g} ({change.most_in} of "
            f"{_short(change.most_of)})"
        )
        if self.u_ratio:
            out.print(f"u of now over u stored: from {self.u_ratio.least:.3g} to {self.u_ratio.most:.3g}")


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}" + ("" if number == 1 else "S" if what.isupper() else "s")


def _option(value: Asked) -> str:
    if isinstance(value, FileAsked):
        return value.file
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)


def _short(run: str) -> str:
    """Return the path of a run relative to the working folder if the run is in that folder."""
    path = Path(run)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else run


def _print_more(listed: Sequence[object], file: str, out: Console) -> None:
    if len(listed) > _ON_SCREEN:
        out.print(f"  … and more, all in {file}")
