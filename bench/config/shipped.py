"""The procedures and bench files that are shipped with the program, by name.

An installed package has them in its folder `shipped_files`; in a checkout they are at the top level.
"""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Final

from bench.base.languages import message
from bench.base.yaml_files import FileMistake, FileMistakes

PROCEDURES: Final = "procedures"
CONFIG: Final = "config"
CERTIFICATE: Final = "config/certificate"
_PACKAGE: Final = Path(__file__).resolve().parents[1]


def shipped_folder(kind: str) -> Path:
    """Return the folder of the shipped files of a kind: `PROCEDURES`, `CONFIG` or `CERTIFICATE`."""
    installed = _PACKAGE / "shipped_files" / kind
    return installed if installed.is_dir() else _PACKAGE.parent / kind


def find_procedure(name: str) -> Path:
    """Return the path of the procedure that `name` states as a path or a name. Raises `FileMistakes`.

    A name selects a copy in the folder `procedures` of the working folder, or else a shipped procedure.
    """
    return _find(name, PROCEDURES, "procedure")


def find_bench(name: str) -> Path:
    """Return the path of the bench file that `name` states as a path or a name. Raises `FileMistakes`.

    A name selects a copy in the folder `config` of the working folder, or else a shipped bench file.
    """
    return _find(name, CONFIG, "bench file")


def _find(name: str, kind: str, called: str) -> Path:
    """Return the existing path `name`, else the copy of that name (`bench init`), else the shipped file."""
    path = Path(name)
    if path.is_file():
        return path
    copy = Path(kind) / f"{name.removesuffix('.yaml')}.yaml"
    if path.parent == Path() and copy.is_file():
        return copy.absolute()
    known = {file.stem: file for file in sorted(shipped_folder(kind).glob("*.yaml"))}
    shipped = known.get(name.removesuffix(".yaml"))
    if shipped is not None:
        return shipped
    near = difflib.get_close_matches(name.removesuffix(".yaml"), known, n=2, cutoff=0.5)
    hint = message(f"did you mean {' or '.join(near)}? ") if near else ""
    listed = ", ".join(known)
    text = message(
        f"there is no such file, and no shipped {called} of that name; {hint}shipped are: {listed}"
    )
    raise FileMistakes(name, [FileMistake(0, "", text)])


def copy_shipped(target: Path) -> list[Path]:
    """Copy the shipped files into `target`; return the paths written.

    They go to the folders procedures, config and config/certificate. Existing files are left unchanged. Raises
    `OSError` if a file cannot be written.
    """
    written = []
    for kind in (PROCEDURES, CERTIFICATE, CONFIG):
        folder = target / kind
        folder.mkdir(parents=True, exist_ok=True)
        for file in sorted(shipped_folder(kind).glob("*.yaml")):
            copy = folder / file.name
            try:
                with copy.open("xb") as stream:
                    stream.write(file.read_bytes())
            except FileExistsError:
                continue
            written.append(copy)
    return written
