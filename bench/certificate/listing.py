"""What a register shows: every certificate, whether chain and files are what they were, files handed out again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.api.errors import Refused
from bench.api.explained import sentence
from bench.base.whole import write_whole
from bench.certificate.life import issued, made_again
from bench.certificate.register import Register


@dataclass(frozen=True)
class Checked:
    """The certificates of a register, a row each, and what is not what it was; `head` stands for its lines."""

    rows: list[dict[str, Any]]
    problems: tuple[str, ...]
    head: str


def checked(register: Register, number: str | None, runs: Path | None) -> Checked:
    """Return what is there, of one number or of all; with `runs` each is made from its record again and compared.

    Raises `Refused` for a number that was never issued.
    """
    numbers = list(register.standings) if number is None else [issued(register, number).entry.number]
    problems = [problem for problem in register.damaged_files() if number is None or f"{number}." in problem]
    rows = []
    for one in numbers:
        standing = register.standings[one]
        entry, unit = standing.entry, standing.entry.data["unit"]
        row = {
            "number": one,
            "issued": entry.time,
            "authorised_by": entry.by,
            "unit": f"{unit['type']} {unit['serial']}".strip(),
            "customer": entry.data["customer"],
            "run": entry.data["run"],
            "simulated": entry.data["simulated"],
            "signed_by": entry.data["signed_by"],
            "state": standing.state,
            "by": standing.by,
            "files": entry.files,
        }
        if runs is not None:
            row["made_again"] = _same(register, one, runs, problems)
        rows.append(row)
    return Checked(rows, tuple(problems), register.head)


def _same(register: Register, number: str, runs: Path, problems: list[str]) -> bool:
    """Whether the unsigned forms, made again, are byte for byte those that were issued."""
    stated = register.standings[number].entry.data["bodies"]
    try:
        again = made_again(register, number, runs).sha256()
    except Exception as error:
        problems.append(f"{number}: cannot be made again: {sentence(error)}")
        return False
    wrong = [name for name, digest in again.items() if stated[name] != digest]
    if wrong:
        problems.append(
            f"{number}: made again, its {' and '.join(wrong)} is not byte for byte what was issued"
        )
    return not wrong


def handed_out(register: Register, number: str, folder: Path) -> list[Path]:
    """Copy the files of a certificate as they were issued into a folder. Raises `Refused`, `OSError`."""
    entry = issued(register, number).entry
    contents = {name: register.file(name) for name in entry.files}
    if folder.absolute() == register.folder.absolute():
        raise Refused(f"--out {folder}: that is the register's own folder; give another")
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        write_whole(folder / name, content)
    return [folder / name for name in contents]
