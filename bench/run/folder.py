"""A run on disk as the analyses see it: its inputs, its history, the readings that stand in it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from bench.base.collecting import uncollected
from bench.base.json_text import read_json
from bench.base.regular import read_regular
from bench.procedure.plan import Plan, Read
from bench.readings.levelled import Seen, with_levels
from bench.readings.reading import readings_of
from bench.readings.table import VERIFICATION, Readings
from bench.run.history import History, read_history
from bench.run.manifest import MANIFEST, Manifest, RecordError, read_manifest

PLAN = "plan.json"
BENCH = "bench.yaml"
PROCEDURE = "procedure.yaml"
MODEL = "model.yaml"
EFFECTS = "effects.yaml"
LEARNED = "learned.yaml"
IMPORTED = "readings.csv"
VERIFY = "verify"
RESULTS = "results.json"
"""Names what was made of a finished run: `made`, null until all of it is there."""
REPORT = "report.html"


@dataclass(frozen=True)
class Run:
    """A run folder, read on demand. Raises `RecordError` where something in it cannot be read."""

    folder: Path

    @property
    def name(self) -> str:
        """Name of the run: its folder's."""
        return self.folder.name

    @cached_property
    def manifest(self) -> Manifest:
        """What the run was started with."""
        return read_manifest(self.folder)

    @cached_property
    def history(self) -> History:
        """The events, checked."""
        return read_history(self.folder)

    @cached_property
    def plan(self) -> Plan:
        """The plan that was, or is to be, carried out."""
        try:
            with uncollected():
                return Plan.from_json(read_json(read_regular(self.folder / PLAN)))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise RecordError(
                f"{self.folder / PLAN}: cannot be read ({error}); take it from a copy"
            ) from error

    @property
    def created(self) -> str:
        """Civil time at which the run was begun, empty where its manifest cannot be read."""
        try:
            return str(self.manifest.get("created", ""))
        except RecordError:
            return ""

    @property
    def imported(self) -> bool:
        """Whether the run was made of a readings file."""
        return "imported" in self.manifest

    @property
    def simulated(self) -> bool:
        """Whether the run was made on simulated instruments."""
        return bool(self.manifest.get("dry_run"))

    @property
    def asks_somebody(self) -> bool:
        """Whether a living person answers the questions of the run, and no scripted one."""
        return not self.simulated or bool(self.manifest.get("living"))

    @property
    def results_missing(self) -> bool:
        """Whether of what is made of the run when it has finished not all is there."""
        try:
            made = read_json((self.folder / RESULTS).read_bytes())["made"]
            return made is None or not all((self.folder / Path(name).name).is_file() for name in made)
        except FileNotFoundError:  # a version before wrote the page and no such list
            return not (self.folder / REPORT).is_file()
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return True

    def trusted_history(self) -> History:
        """Return the history. Raises `RecordError` when a line or an input was changed."""
        if self.history.problems:
            raise RecordError(
                f"{self.folder}: the record cannot be trusted: {'; '.join(self.history.problems)}"
            )
        return self.history

    def readings(self) -> Readings:
        """Return the readings on record, in the order of measurement; of a repeated step the last counts.

        Raises `RecordError` when the record was changed, or holds no reading.
        """
        taken = list(self.trusted_history().readings.values())
        if not taken:
            raise RecordError(f"{self.folder}: no reading is recorded in this run")
        planned = sum(isinstance(s, Read) and s.installation == VERIFICATION for s in self.plan.steps)
        table = with_levels(readings_of(taken, str(self.folder)), self._seen_by_level())
        return replace(
            table,
            verification_missing=planned - len(table.verification()),
            notes=self._unfinished_note(len(taken)),
        )

    def _seen_by_level(self) -> list[Seen]:
        return [
            Seen(
                bench_s,
                (one.level_series, one.level_of),
                one.adjusted,
                (one.alpha1_arcsec, one.alpha2_arcsec),
                (one.u_alpha1_arcsec, one.u_alpha2_arcsec),
            )
            for bench_s, one in self.trusted_history().levelled
        ]

    def _unfinished_note(self, taken: int) -> tuple[str, ...]:
        """Say how much of the plan was measured, where it is not all."""
        history = self.trusted_history()
        out = history.progress.left_out
        planned = [i for i, step in enumerate(self.plan.steps) if isinstance(step, Read)]
        needed = sum(i not in out for i in planned)
        notes = []
        if out:
            asked = ", ".join(self.manifest.get("until", ()))
            notes.append(
                f"measured until {asked}: {len(planned) - needed} of {len(planned)} planned readings were left out"
            )
        if taken != needed:
            notes.append(f"the run is {history.state}: {taken} of {needed} planned readings were taken")
        return tuple(notes)


def checked_name(name: str) -> str:
    """Return the name of a run, which is that of its folder and an argument of commands.

    Raises `RecordError` for one that could not be typed, or would lie elsewhere.
    """
    if re.fullmatch(r"\w[\w.+-]{0,99}", name) is None:
        raise RecordError(
            f"{name!r}: a run's name is a letter or digit, then up to 99 letters, digits, dots, dashes and plusses"
        )
    return name


def find_run(name: str, runs: Path) -> Run:
    """Find a run by its name in the folder of runs, or by its path.

    Raises `RecordError` that lists the runs there are.
    """
    for folder in (runs / name, Path(name)):
        if (folder / MANIFEST).is_file():
            return Run(folder)
    there = ", ".join(run.name for run in all_runs(runs)[-5:]) or "none"
    raise RecordError(f"{name}: no run of that name in {runs} and no such path; the latest runs are: {there}")


def all_runs(runs: Path) -> list[Run]:
    """Return the runs in a folder, oldest first."""
    if not runs.is_dir():
        return []
    found = [Run(folder) for folder in runs.iterdir() if (folder / MANIFEST).is_file()]
    return sorted(found, key=lambda run: (run.created, run.name))
