"""A run that somebody wants to start, and what was found of it before: all as files, so that nothing is lost."""

from __future__ import annotations

import re
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout

from bench.base.regular import read_regular
from bench.base.whole import from_text, to_text, write_whole
from bench.panel.access.people import Refusal
from bench.run.manifest import sha256

WISH: Final = "wish.json"
FOUND: Final = "found.json"
LOCK: Final = "lock"
STARTED: Final = "started"
MOST_KEPT: Final = 20
MOST_AT_ONCE: Final = 2


@dataclass(frozen=True)
class Wanted:
    """What is to be run: procedure and bench by path with the SHA-256 that they were checked with, unit, operator.

    `practice` is a dry run that asks a person; `name` is the run's, empty where it is to be found.
    """

    procedure: str
    bench: str
    unit: str = ""
    operator: str = ""
    name: str = ""
    practice: bool = False
    sha256: Mapping[str, str] = field(default_factory=dict)

    def hashed(self) -> Wanted:
        """Return it with the hashes of its files as they are now. Raises `Refusal`."""
        return replace(self, sha256=self._hashes())

    def changed(self) -> bool:
        """Whether its files are others than those that were checked. Raises `Refusal`."""
        return dict(self.sha256) != self._hashes()

    def _hashes(self) -> dict[str, str]:
        try:
            return {path: sha256(read_regular(Path(path))) for path in (self.procedure, self.bench)}
        except OSError as error:
            raise Refusal(409, f"{error.filename}: cannot be read ({error.strerror})") from error


@dataclass(frozen=True)
class Found:
    """What check and dry run found. `stage` is "checking", "trying" or "done".

    `check` are the findings as `bench check --json` has them, `mistakes` what keeps the files from being read;
    `tried` the exit status of the dry run, None where there was none, and `said` its last words; `result` what
    `bench run --json` wrote.
    """

    stage: str = "checking"
    check: dict[str, Any] | None = None
    mistakes: str = ""
    tried: int | None = None
    said: str = ""
    result: dict[str, Any] | None = None

    @property
    def startable(self) -> bool:
        """Whether nothing forbids to start; a dry run refused for want of answers does not."""
        if self.stage != "done" or self.check is None or self.check["problems"]:
            return False
        return self.tried in {0, 1} or bool(self.check["dry_run_refuses"])


class WishFolder:
    """The folder of one wish."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def id(self) -> str:
        """Its name, as addresses have it."""
        return self.path.name

    def wanted(self) -> Wanted:
        """Return what is wanted. Raises `Refusal`."""
        return Wanted(**self._read(WISH))

    def found(self) -> Found:
        """Return what was found so far. Raises `Refusal`."""
        return Found(**self._read(FOUND))

    def tell(self, found: Found) -> None:
        """Keep what was found so far."""
        write_whole(self.path / FOUND, to_text(asdict(found)))

    def lock(self) -> FileLock:
        """Return the lock that whoever checks and tries has as long as it lives."""
        return FileLock(self.path / LOCK, mode=0o600)

    def at_work(self) -> bool:
        """Whether somebody checks or tries now."""
        try:
            with self.lock().acquire(timeout=0):
                return False
        except Timeout:
            return True
        except OSError:
            return False

    def mark_started(self, name: str) -> None:
        """Note which run was started of it, once. Raises `Refusal` where one was."""
        try:
            with (self.path / STARTED).open("x", encoding="utf-8") as file:
                file.write(name)
        except FileExistsError:
            raise Refusal(409, f"this was started already, as {self.started()}") from None

    def unmark_started(self) -> None:
        """Forget that it was started, as it did not begin."""
        (self.path / STARTED).unlink(missing_ok=True)

    def started(self) -> str:
        """Return which run was started of it, empty where none was."""
        try:
            return read_regular(self.path / STARTED).decode()
        except OSError:
            return ""

    def _read(self, name: str) -> dict[str, Any]:
        try:
            told = from_text(read_regular(self.path / name))
        except (OSError, ValueError):
            told = None
        if not isinstance(told, dict):
            raise Refusal(404, "this is not there any more; begin again")
        return told


class Wishes:
    """The wishes of a panel, the latest few."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def new(self, wanted: Wanted) -> WishFolder:
        """Keep a wish and return its folder. Raises `Refusal` where too many are being tried."""
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
        wish.tell(Found())
        return wish

    def of(self, wish_id: str) -> WishFolder:
        """Return the folder of a wish. Raises `Refusal` (404)."""
        if re.fullmatch(r"[0-9a-f]{12}", wish_id) is None or not (self._folder / wish_id / WISH).is_file():
            raise Refusal(404, "this is not there any more; begin again")
        return WishFolder(self._folder / wish_id)
