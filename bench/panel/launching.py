"""Processes that the panel starts: check, dry run, run, resuming, diagnosis."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

from bench.base.files import from_text, open_regular, read_regular, to_text, write_whole
from bench.base.languages import message
from bench.base.requests import fields_of
from bench.base.text import visible
from bench.base.yaml_files import FileMistakes
from bench.panel.access import Person, Refusal, is_held, private_folder
from bench.panel.folder import RunsFolder
from bench.run.events import EVENTS, RecordError, sha256
from bench.run.folder import Run, checked_name
from bench.run.record import is_being_written
from bench.services.errors import Refused, sentence
from bench.services.persons import STARTED_FROM
from bench.services.requests.measuring import RunRequest
from drivers.clock import SystemClock, utc_now

BENCH: Final = ("-c", "from bench.cli.program import main; main()")
NAP_S: Final = 0.05
LONGEST_START_S: Final = 30.0
LAST_WORDS: Final = 4000


@dataclass(frozen=True)
class Started:
    """A started process and the file with its output."""

    process: subprocess.Popen[bytes]
    log: Path

    @property
    def status(self) -> int | None:
        """The exit status, None while the process is alive."""
        return self.process.poll()


def start(arguments: Sequence[str], log: Path, *, program: Sequence[str] = BENCH, role: str = "") -> Started:
    """Start a process that outlives this program, without a shell; its output goes to `log`. Raises `OSError`.

    `role` is the role of the person for whom the process acts, empty for none.
    """
    with log.open("wb") as out:
        process = subprocess.Popen(  # noqa: S603 - a program of ours, arguments that were checked
            [sys.executable, *program, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, STARTED_FROM: f"panel {role}".rstrip()},
        )
    # reap the process at its end; otherwise it would stay a zombie
    threading.Thread(target=process.wait, daemon=True).start()
    return Started(process, log)


def wait_until(begun: Callable[[], bool], started: Started) -> bool:
    """Wait until `begun()` is True; return False after 30 s. Raises `Refusal` if the process ends before that."""
    clock = SystemClock()
    until_s = clock.now_s() + LONGEST_START_S
    while not begun():
        if (status := started.status) is not None:
            if begun():
                return True
            if words := last_words(started.log):
                told = message(
                    f"the run did not start (exit status {status}); remove the cause that it states: {words}"
                )
            else:
                told = message(
                    f"the run did not start (exit status {status}) and stated no cause; start it with 'bench run' "
                    "in a terminal"
                )
            raise Refusal(409, told)
        if clock.now_s() > until_s:
            return False
        clock.sleep(NAP_S)
    return True


def last_words(log: Path) -> str:
    """Return the end of a process's output in the file `log`; an empty string if it cannot be read."""
    try:
        with open_regular(log) as file:
            file.seek(max(file.seek(0, 2) - LAST_WORDS, 0))
            return visible(file.read().decode(errors="replace")).strip()
    except OSError:
        return ""


WISH: Final = "wish.json"
FOUND: Final = "found.json"
LOCK: Final = "lock"
STARTED: Final = "started"
MOST_KEPT: Final = 20
MOST_AT_ONCE: Final = 2


@dataclass(frozen=True)
class WantedRun:
    """A requested run: the fields of `RunRequest` from the form, and the hashes of its files at the check.

    Procedure and bench are absolute paths; `sha256` has the hashes of these files. If the requested run is a dry
    run, a person answers its prompts for practice. `queued` is the id of its queue item, empty for none.
    """

    fields: Mapping[str, str | bool]
    sha256: Mapping[str, str] = field(default_factory=dict)
    queued: str = ""

    @property
    def request(self) -> RunRequest:
        """The request for `bench run`."""
        return RunRequest(**{"procedure": "", **self.fields})  # type: ignore[arg-type]

    def hashed(self) -> WantedRun:
        """Return a copy with the present hashes of the files. Raises `Refusal` if a file cannot be read."""
        return replace(self, sha256=self._hashes())

    def changed(self) -> bool:
        """Return whether the files changed since the check. Raises `Refusal` if a file cannot be read."""
        return dict(self.sha256) != self._hashes()

    def _hashes(self) -> dict[str, str]:
        try:
            return {
                path: sha256(read_regular(Path(path)))
                for path in (str(self.request.procedure), str(self.request.bench))
            }
        except OSError as error:
            raise Refusal(
                409,
                f"{error.filename}: cannot be read ({error.strerror}); check name and permissions",
            ) from error


@dataclass(frozen=True)
class TrialResult:
    """The findings of the check and the dry run that precede a run. `stage` is "checking", "trying" or "done".

    `check` is the output of `bench check --json`; `mistakes` are the errors in files that cannot be read.
    `tried` is the exit status of the dry run (None without one), `said` the end of its output, `result` the
    output of `bench run --json`.
    """

    stage: str = "checking"
    check: dict[str, Any] | None = None
    mistakes: str = ""
    tried: int | None = None
    said: str = ""
    result: dict[str, Any] | None = None

    @property
    def startable(self) -> bool:
        """Whether check and dry run allow a start; no dry run is needed if a prompt has no default answer."""
        if self.stage != "done" or self.check is None or self.check["problems"]:
            return False
        return self.tried in {0, 1} or bool(self.check["dry_run_refuses"])


class WorkFolder:
    """A folder in which a process of the panel stores its findings; a lock shows that the process is alive."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def tell(self, found: Any) -> None:
        """Store the findings so far: `found`, a dataclass."""
        write_whole(self.path / FOUND, to_text(asdict(found)))

    def lock(self) -> FileLock:
        """Return the lock that the folder's process holds while it is alive."""
        return FileLock(self.path / LOCK, mode=0o600)

    def at_work(self) -> bool:
        """Return whether a process is at work in the folder now."""
        return is_held(self.lock())


class WishFolder(WorkFolder):
    """The folder of one requested run (a wish)."""

    @property
    def id(self) -> str:
        """The folder's name, which identifies the wish in addresses."""
        return self.path.name

    def wanted(self) -> WantedRun:
        """Return the requested run. Raises `Refusal` (404) if it was deleted."""
        return WantedRun(**self._read(WISH))

    def found(self) -> TrialResult:
        """Return the findings so far. Raises `Refusal` (404) if they were deleted."""
        return TrialResult(**self._read(FOUND))

    def mark_started(self, name: str) -> None:
        """Record the name of the run started from this wish. Raises `Refusal` if one was started already."""
        try:
            with (self.path / STARTED).open("x", encoding="utf-8") as file:
                file.write(name)
        except FileExistsError:
            raise Refusal(409, f"this run was already started; see {self.started()}") from None

    def unmark_started(self) -> None:
        """Delete the record of `mark_started`, because the run did not begin."""
        (self.path / STARTED).unlink(missing_ok=True)

    def started(self) -> str:
        """Return the name of the run started from this wish; "" if no run was started."""
        try:
            return read_regular(self.path / STARTED).decode()
        except OSError:
            return ""

    def _read(self, name: str) -> dict[str, Any]:
        told = _object_in(self.path / name)
        if told is None:
            raise Refusal(404, "this prepared run no longer exists; prepare it again")
        return told


class Wishes:
    """The latest requested runs (wishes) of a panel, each in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def new(self, wanted: WantedRun) -> WishFolder:
        """Store a requested run and return its folder; the oldest idle folders beyond `MOST_KEPT` are deleted.

        Raises `Refusal` (429) if `MOST_AT_ONCE` requested runs are in their check or dry run already.
        """
        self._folder.mkdir(mode=0o700, exist_ok=True)
        before = [one for one in self._folder.iterdir() if one.is_dir()]
        before.sort(key=lambda one: one.stat().st_mtime)
        idle = [one for one in before if not WishFolder(one).at_work()]
        if len(before) - len(idle) >= MOST_AT_ONCE:
            raise Refusal(429, "two runs are being tried already; wait until one is done")
        for old in idle[: max(len(before) - MOST_KEPT + 1, 0)]:
            shutil.rmtree(old, ignore_errors=True)
        wish = WishFolder(self._folder / secrets.token_hex(6))
        wish.path.mkdir(mode=0o700)
        write_whole(wish.path / WISH, to_text(asdict(wanted)))
        wish.tell(TrialResult())
        return wish

    def of(self, wish_id: str) -> WishFolder:
        """Return the folder of the wish with this id. Raises `Refusal` (404) if there is none."""
        if re.fullmatch(r"[0-9a-f]{12}", wish_id) is None or not (self._folder / wish_id / WISH).is_file():
            raise Refusal(404, "this prepared run no longer exists; prepare it again")
        return WishFolder(self._folder / wish_id)


ANSWERS: Final = "folder"
OUTPUT: Final = "panel.log"
"""The file with the terminal output of the program that carries out a run, in the folder of the wish."""


def arguments_of(request: RunRequest) -> Iterator[str]:
    """Yield the command-line arguments of `bench run` that express a request."""
    for one in fields_of(type(request)):
        value = getattr(request, one.name)
        flag = (one.option.flags or (f"--{one.name.replace('_', '-')}",))[0]
        if one.option.argument:
            yield str(value)
        elif value is True:
            yield flag
        elif value != one.default and value is not None:
            yield from (f"{flag}={text}" for text in (value if isinstance(value, list) else [value]))


def name_of(wanted: WantedRun, runs: RunsFolder) -> str:
    """Return a run's typed name, else one of procedure and time. Raises `Refusal` for an unusable name."""
    stem = re.sub(r"[^\w.+-]", "-", Path(wanted.request.procedure).stem)
    name = wanted.request.name or f"{stem}-{utc_now().astimezone():%Y%m%d-%H%M%S}"
    try:
        checked_name(name)
    except RecordError as mistake:
        raise Refusal(400, str(mistake)) from mistake
    if (runs.path / name).exists():
        raise Refusal(409, f"the run {name} exists; choose another name")
    return name


def start_run(wish: WishFolder, name: str, runs: RunsFolder) -> Run:
    """Start a requested run called `name` in a separate process, and wait for its record.

    Raises `Refusal` if a file changed after the check, if the run was started already, or if it does not begin.
    """
    wanted = wish.wanted()
    if wanted.changed():
        raise Refusal(409, "procedure or bench file changed after the check; check them again")
    wish.mark_started(name)
    asked = replace(wanted.request, name=name, runs=runs.path.absolute(), answers=ANSWERS)
    arguments = ["run", *arguments_of(asked)]
    folder = runs.path / name
    try:
        started = start(arguments, wish.path / OUTPUT)
        begun = wait_until((folder / EVENTS).exists, started)
    except BaseException:
        wish.unmark_started()
        raise
    if not begun:
        raise Refusal(409, "starting takes long; look at the list of runs in a moment")
    return runs.run(name)


def resume_run(run: Run, by: Person) -> None:
    """Resume a run for a person, or compute a finished run's missing results, in a separate process.

    Raises `Refusal` if a program is carrying out the run already, or if the process ends before doing so.
    """
    if is_being_written(run.folder):
        raise Refusal(409, "a program is carrying out this run now; follow it on the run's page")
    arguments = ["resume", str(run.folder.absolute()), f"--runs={_runs(run)}", f"--answers={ANSWERS}"]
    started = start([*arguments, f"--operator={by.name}"], _output(run), role=by.role.value)
    wait_until(lambda: is_being_written(run.folder) or not run.results_missing, started)


def diagnose(run: Run) -> Started:
    """Start the diagnosis of a run in a separate process, and return the process."""
    target = run.folder.absolute()
    return start(
        ["diagnose", str(target), f"--runs={_runs(run)}", f"--json={target / 'diagnose.json'}"], _output(run)
    )


def _output(run: Run) -> Path:
    folder = private_folder(run.folder.parent / ".panel" / "output")
    return folder / f"{run.name}.log"


def _runs(run: Run) -> Path:
    return run.folder.parent.absolute()


# --- the process that checks and tries a wish: python -m bench.panel.launching FOLDER ------------------


def main() -> None:
    """Carry out the check and the dry run of the requested run whose folder is on the command line."""
    wish = WishFolder(Path(sys.argv[1]))
    with wish.lock():
        found = checked(wish.wanted(), wish.path)
        if found.stage == "trying":
            wish.tell(found)
            found = tried(wish, found)
        wish.tell(found)


def checked(wanted: WantedRun, folder: Path) -> TrialResult:
    """Return the findings of `bench check`; the stage is "trying" if a dry run is possible, else "done"."""
    from bench.services.requests.measuring import Check
    from bench.services.until import look_ahead

    try:
        findings = look_ahead(Check(str(wanted.request.procedure), bench=wanted.request.bench, runs=folder))
    except (Refused, FileMistakes) as mistakes:
        return TrialResult("done", mistakes=sentence(mistakes))
    return TrialResult("trying" if findings.can_be_tried else "done", check=findings.result.to_dict())


def tried(wish: WishFolder, found: TrialResult) -> TrialResult:
    """Carry out the dry run of a requested run; return the findings with its outcome added."""
    log, result = wish.path / "dry-run.log", wish.path / "dry-run.json"
    trial = replace(wish.wanted().request, dry_run=True, name="trial", runs=wish.path / "runs", operator="")
    arguments = ["run", *arguments_of(trial), f"--json={result}"]
    with log.open("wb") as out:
        status = subprocess.run(  # noqa: S603 - a program of ours, arguments that were checked
            [sys.executable, *BENCH, *arguments],
            stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT, check=False,
        ).returncode  # fmt: skip
    return replace(found, stage="done", tried=status, said=last_words(log), result=_object_in(result))


def _object_in(file: Path) -> dict[str, Any] | None:
    try:
        told = from_text(read_regular(file))
    except (OSError, ValueError):
        return None
    return told if isinstance(told, dict) else None


if __name__ == "__main__":
    main()
