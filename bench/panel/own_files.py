"""Bench files and procedures: lists to choose from, reading, and writing if nobody else changed the file."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from filelock import FileLock

from bench.base.files import MEGABYTE, open_regular, read_regular, write_whole
from bench.base.languages import message
from bench.base.yaml_files import FileMistakes
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Mount, Read, Turn
from bench.config.shipped import CONFIG, PROCEDURES, shipped_folder
from bench.panel.access import Refusal, private_folder
from bench.panel.folder import RunsFolder
from bench.run.events import sha256
from bench.run.sentences import duration

NAME: Final = re.compile(r"\w[\w-]{0,59}")
LOCK: Final = "bench-files.lock"
CALLED: Final = {CONFIG: message("bench file"), PROCEDURES: "procedure"}
"""The name of a file of each folder in sentences."""


@dataclass(frozen=True)
class FileText:
    """The text of a file, and its hash, which is empty for a file that does not exist yet."""

    path: Path
    text: str
    sha256: str = ""


MARKS: Final = {
    PROCEDURES: re.compile(rb"^procedure\s*:", re.MULTILINE),
    CONFIG: re.compile(rb"^instruments\s*:", re.MULTILINE),
}
"""Patterns that identify a file in the working folder as a procedure or a bench file."""

NEXT: Final = "diagnose-next.yaml"
"""The procedure that the diagnosis of a run proposes, in the run's folder."""
OF_RUN: Final = "next:"
BEGINNING: Final = 65_536


def choices(kind: str) -> dict[str, Path]:
    """Return the files of a kind (`PROCEDURES`, `CONFIG`) by name; files of the user hide shipped ones."""
    here = Path()
    found = {file.stem: file for file in _yaml(shipped_folder(kind))}
    found |= {file.stem: file for file in _yaml(here / kind)}
    found |= {file.name: file for file in _yaml(here) if MARKS[kind].search(_beginning(file))}
    named = os.environ.get("BENCH_FILE", "")
    if kind == CONFIG and named and Path(named).is_file():
        found[named] = Path(named)
    return dict(sorted(found.items()))


def chosen_procedure(name: str, runs: RunsFolder) -> Path:
    """Return a procedure's path; `next:RUN` is the one that RUN's diagnosis proposes. Raises `Refusal`."""
    if name.startswith(OF_RUN):
        run = runs.run(name.removeprefix(OF_RUN))
        file = run.folder / NEXT
        if file.is_symlink() or not file.is_file():
            raise Refusal(404, f"{run.name}: its diagnosis proposes no measurement; choose a procedure")
        return file
    return _chosen(PROCEDURES, name, "procedure")


def chosen_bench(name: str, runs: RunsFolder) -> Path:
    """Return a bench file's path; `next:RUN` is the one with which RUN was made. Raises `Refusal`."""
    if name.startswith(OF_RUN):
        run = runs.run(name.removeprefix(OF_RUN))
        original = Path(str(run.manifest.get("bench", "")))
        if original in choices(CONFIG).values() or original.name in choices(CONFIG):
            return original
        raise Refusal(404, f"{run.name}: its bench file is no longer here; choose one")
    return _chosen(CONFIG, name, message("bench file"))


def _chosen(kind: str, name: str, called: str) -> Path:
    found = choices(kind).get(name)
    if found is None:
        raise Refusal(400, f"there is no {called} of that name; choose from the list")
    return found


def _yaml(folder: Path) -> list[Path]:
    try:
        return sorted(file for file in folder.iterdir() if file.suffix == ".yaml" and file.is_file())
    except OSError:
        return []


def _beginning(file: Path) -> bytes:
    try:
        with open_regular(file) as stream:
            return stream.read(BEGINNING)
    except OSError:
        return b""


def own_files(kind: str) -> dict[str, Path]:
    """Return the working folder's `CONFIG` or `PROCEDURES` files by name, without links leading out of it."""
    here = Path().resolve()
    shipped = shipped_folder(kind).resolve()
    found = {name: (path, path.resolve()) for name, path in choices(kind).items() if "/" not in name}
    return {
        name: path
        for name, (path, real) in found.items()
        if real.is_relative_to(here) and (real.parent != shipped or shipped == here / kind)
    }


def shipped_files(kind: str) -> dict[str, Path]:
    """Return the shipped files of a kind by name."""
    return {path.stem: path for path in sorted(shipped_folder(kind).glob("*.yaml"))}


def own_file(kind: str, name: str) -> Path:
    """Return the file of this kind and name in the working folder. Raises `Refusal` (404) if there is none."""
    path = own_files(kind).get(name)
    if path is None:
        raise Refusal(404, f"there is no {CALLED[kind]} of that name in the working folder; see the list")
    return path


def shipped_file(kind: str, name: str) -> Path:
    """Return the shipped file of this kind and name. Raises `Refusal` (404) if there is none."""
    path = shipped_files(kind).get(name)
    if path is None:
        raise Refusal(404, f"no {CALLED[kind]} of that name is shipped; choose one from the list")
    return path


def new_path(kind: str, name: str) -> Path:
    """Return the path of a new file in the folder of its kind. Raises `Refusal` (400, 409).

    A name has letters, digits, `-` and `_`; it must differ from the names of the other files of the kind.
    """
    if NAME.fullmatch(name) is None:
        raise Refusal(
            400,
            "the name is not allowed; give up to 60 letters, digits, - and _, beginning with a "
            "letter or digit",
        )
    path = Path(kind) / f"{name}.yaml"
    if not path.resolve().is_relative_to(Path().resolve()):
        raise Refusal(
            409, f"the folder '{kind}' is a symbolic link out of the working folder; remove the link"
        )
    if path.exists() or path.is_symlink() or name in own_files(kind) or name in shipped_files(kind):
        raise Refusal(409, f"there is a {CALLED[kind]} {name} already; choose another name")
    return path


def read_file(path: Path) -> FileText:
    """Return the text of a file with its hash. Raises `Refusal` if it cannot be read."""
    try:
        content = read_regular(path, MEGABYTE)
        return FileText(path, content.decode("utf-8-sig").replace("\r\n", "\n"), sha256(content))
    except OSError as error:
        raise Refusal(
            409,
            f"{path}: cannot be read ({error.strerror}); check its name and permissions on the computer that "
            "runs the panel",
        ) from error
    except UnicodeDecodeError as error:
        raise Refusal(409, f"{path}: is not UTF-8 text; save it as UTF-8") from error


def write_file(path: Path, text: str, expected_sha256: str, state: Path) -> bool:
    """Write a file atomically; return whether it was written.

    A file whose hash is no longer `expected_sha256` (empty for a new file) is not written. `state` is the
    panel's private folder, which holds the lock. Raises `OSError`.
    """
    with FileLock(private_folder(state) / LOCK, mode=0o600):
        before = read_regular(path) if path.exists() else None
        if (sha256(before) if before is not None else "") != expected_sha256:
            return False
        path.parent.mkdir(exist_ok=True)
        ends = "\r\n" if before is not None and b"\r\n" in before else "\n"
        write_whole(path, text.replace("\n", ends))
        return True


# --- procedures that may be chosen --------------------------------------------------------------------

MOST_OFFERED: Final = 500
"""Number of procedures whose duration is cached."""


@dataclass(frozen=True)
class OfferedProcedure:
    """A procedure as the form offers it: its title, expected time, number of readings, and a drawing.

    `dots` are the test points by angle, as (x to the right, y down) on a circle of radius 1. For a file with
    mistakes, `title` is the first mistake and all else is empty.
    """

    name: str
    title: str
    expected_s: float = 0.0
    readings: int = 0
    mountings: int = 0
    dots: tuple[tuple[float, float], ...] = ()

    @property
    def time(self) -> str:
        """The expected time in words, empty for a file with mistakes."""
        return duration(self.expected_s) if self.dots or self.expected_s else ""


def offered_procedures() -> list[OfferedProcedure]:
    """Return the procedures that may be chosen, each with its duration on a typical bench."""
    return [offered(name, file) for name, file in choices(PROCEDURES).items()]


def offered(name: str, file: Path) -> OfferedProcedure:
    """Return a procedure as the forms offer it, from a cache until the file changes."""
    return _offered(name, file, file.stat().st_mtime_ns if file.is_file() else 0)


@lru_cache(maxsize=MOST_OFFERED)
def _offered(name: str, file: Path, _changed_ns: int) -> OfferedProcedure:
    try:
        procedure = load_procedure(file)
    except (FileMistakes, OSError, ValueError) as mistakes:
        return OfferedProcedure(name, str(mistakes).partition("\n")[0])
    plan = procedure.plan
    angles = sorted({step.target_rad for step in plan.steps if isinstance(step, Turn)})
    return OfferedProcedure(
        name,
        procedure.title,
        plan.expected_duration_s(),
        sum(isinstance(step, Read) for step in plan.steps),
        sum(isinstance(step, Mount) for step in plan.steps),
        tuple((round(math.sin(angle), 3), round(-math.cos(angle), 3)) for angle in angles),
    )
