"""Bench files of the working folder: which there are, their text, and writing one that nobody else changed."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from filelock import FileLock

from bench.base.files import MEGABYTE, read_regular, write_whole
from bench.base.languages import message
from bench.base.yaml_files import FileMistake, FileMistakes, document_of, validated
from bench.config.bench_file.file import BenchFile
from bench.config.shipped import CONFIG, shipped_folder
from bench.panel.access import Refusal, private_folder
from bench.panel.launching import choices
from bench.run.events import sha256

NAME: Final = re.compile(r"\w[\w-]{0,59}")
LOCK: Final = "bench-files.lock"


@dataclass(frozen=True)
class BenchText:
    """The text of a bench file and its hash, empty for a file that does not exist yet."""

    path: Path
    text: str
    sha256: str = ""


@dataclass(frozen=True)
class Listed:
    """A bench file in the list: its name, its description, and the number of its mistakes."""

    name: str
    path: str
    description: str
    mistakes: int


def own_files() -> dict[str, Path]:
    """Return the bench files of the working folder by name: those in `config` and beside it, and no links out."""
    here = Path().resolve()
    shipped = shipped_folder(CONFIG).resolve()
    found = {name: (path, path.resolve()) for name, path in choices(CONFIG).items() if "/" not in name}
    return {
        name: path
        for name, (path, real) in found.items()
        if real.is_relative_to(here) and (real.parent != shipped or shipped == here / CONFIG)
    }


def shipped_files() -> dict[str, Path]:
    """Return the shipped bench files by name."""
    return {path.stem: path for path in sorted(shipped_folder(CONFIG).glob("*.yaml"))}


def listed() -> list[Listed]:
    """Return the bench files of the working folder for the list."""
    rows = []
    for name, path in own_files().items():
        try:
            text = read_bench(path)
            mistakes, file = mistakes_in(text.text, path)
        except Refusal:
            mistakes, file = (FileMistake(0, "", message("it cannot be read")),), None
        rows.append(Listed(name, str(path), file.description if file else "", len(mistakes)))
    return rows


def own_file(name: str) -> Path:
    """Return the bench file of the working folder with this name. Raises `Refusal` (404) if there is none."""
    path = own_files().get(name)
    if path is None:
        raise Refusal(
            404, message("there is no bench file of that name in the working folder; see the list of benches")
        )
    return path


def shipped_file(name: str) -> Path:
    """Return the shipped bench file with this name. Raises `Refusal` (404) if there is none."""
    path = shipped_files().get(name)
    if path is None:
        raise Refusal(404, message("no bench file of that name is shipped; choose one from the list"))
    return path


def new_path(name: str) -> Path:
    """Return the path of a new bench file in the folder `config`. Raises `Refusal` (400, 409).

    A name is letters, digits, `-` and `_`; it must not be that of another bench file.
    """
    if NAME.fullmatch(name) is None:
        raise Refusal(
            400, message("a name is up to 60 letters, digits, - and _, and begins with a letter or digit")
        )
    path = Path(CONFIG) / f"{name}.yaml"
    if not path.resolve().is_relative_to(Path().resolve()):
        raise Refusal(409, message("the folder 'config' leads out of the working folder; remove that link"))
    if path.exists() or path.is_symlink() or name in own_files() or name in shipped_files():
        raise Refusal(409, message(f"there is a bench file {name} already; choose another name"))
    return path


def read_bench(path: Path) -> BenchText:
    """Return the text of a bench file with its hash. Raises `Refusal` if it cannot be read."""
    try:
        content = read_regular(path, MEGABYTE)
        return BenchText(path, content.decode("utf-8-sig").replace("\r\n", "\n"), sha256(content))
    except OSError as error:
        raise Refusal(
            409, message(f"{path}: cannot be read ({error.strerror}); look at it on this computer")
        ) from error
    except UnicodeDecodeError as error:
        raise Refusal(409, message(f"{path}: is not UTF-8 text; save it as UTF-8")) from error


def mistakes_in(text: str, path: Path) -> tuple[tuple[FileMistake, ...], BenchFile | None]:
    """Return the mistakes of a bench file with this text, and the bench file if there are none."""
    try:
        return (), validated(document_of(path, text.encode()), BenchFile)
    except FileMistakes as mistakes:
        return mistakes.mistakes, None


def difference(before: str, after: str, name: str) -> str:
    """Return the lines in which two texts differ: "-" before those of the first, "+" before those of the second."""
    lines = difflib.unified_diff(
        before.splitlines(),
        after.splitlines(),
        message(f"{name} as it is"),
        message(f"{name} as written here"),
        lineterm="",
        n=1,
    )
    return "\n".join(lines)


def write_bench(path: Path, text: str, expected_sha256: str, state: Path) -> bool:
    """Write a bench file atomically; return whether it was written.

    It is not written if it has changed since its hash was `expected_sha256`, which is empty for a new file.
    `state` is the panel's private folder, which holds the lock. Raises `OSError`.
    """
    with FileLock(private_folder(state) / LOCK, mode=0o600):
        before = read_regular(path) if path.exists() else None
        if (sha256(before) if before is not None else "") != expected_sha256:
            return False
        path.parent.mkdir(exist_ok=True)
        ends = "\r\n" if before is not None and b"\r\n" in before else "\n"
        write_whole(path, text.replace("\n", ends))
        return True
