"""The pictures that the build makes: which there are, what makes them, and their alternative texts.

A page shows one by the directive `{picture} NAME` of `docs/site_parts.py`.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final

from docs.generators import drawings, panel_pictures, screens, terminal

FOLDER: Final = "pictures"
ROOT: Final = Path(__file__).parents[2]
THERE: Final = ROOT / "docs" / "reference" / FOLDER
SCHEMES: Final = ("light", "dark")

DRAWINGS: Final[dict[str, tuple[Callable[[str], str], str]]] = {
    "mountings": (
        drawings.mountings,
        "Three drawings of the platform with the block, seen from the end of the shaft with the head at 0"
        " degrees. "
        "Installation 1: x right, y away along the shaft, z up. Installation 2: x left, y up, z away. "
        "V: as 1, turned by 45 degrees about the platform's normal.",
    ),
    "turning": (
        drawings.turning,
        "Two drawings of the head at 45 degrees: reached with rising angle, counterclockwise, and with "
        "falling angle.",
    ),
    "wiring": (
        drawings.wiring,
        "Each channel of the block is connected with signal and return to HI and LO of its own voltmeter, "
        "its shield to LO at the meter's end only; two rails and ground come from the power supply; a Pt100 "
        "goes to the thermometer; each instrument has its own address at the computer.",
    ),
    "stand": (
        drawings.stand,
        "The stand of the paper's figure 4 with its eleven numbered parts, and beside it the bench file's"
        " key of each.",
    ),
    "rules": (
        drawings.rules,
        "A scale of the error: pass up to the limit less the guard band, conditional pass up to the "
        "limit, conditional "
        "fail up to the limit plus the guard band, fail beyond.",
    ),
    "learned": (
        drawings.learned,
        "For each angle of the stand a band, the limit of the bench file, and within it the mean with 2u "
        "from three dry runs.",
    ),
    "session": (
        terminal.shown,
        "A terminal session: a dry run, its verdict, and the diagnosis of a faulty bench.",
    ),
}
"""Drawings by name: what makes each, and its alternative text."""
TAKEN: Final[dict[str, str]] = {
    **screens.PICTURES,
    **panel_pictures.PICTURES,
    "certificate": "Page 1 of a certificate: laboratory, customer, unit, the twelve coefficients with U, "
    "and the statement "
    "of conformity with its rule.",
}  # fmt: skip
"""Screenshots by name, with their alternative texts; `example_certificate` writes the last."""


def write_all() -> None:
    """Take all screenshots, unless those of an earlier build are of this very program."""
    made_of, kept = program(), THERE / "made-of.txt"
    if kept.is_file() and kept.read_text(encoding="utf-8") == made_of:
        return
    shutil.rmtree(THERE, ignore_errors=True)
    panel_pictures.write_pictures(THERE)
    screens.write_screens(THERE)
    if all((THERE / f"{name}-light.png").is_file() for name in (*screens.PICTURES, *panel_pictures.PICTURES)):
        kept.write_text(made_of, encoding="utf-8")


def program() -> str:
    """Return the SHA-256 of the files that a picture depends on."""
    hashed = hashlib.sha256()
    for folder in ("bench", "drivers", "sim", "config", "procedures", "docs/generators"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.is_file() and path.suffix != ".pyc":
                hashed.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    return hashed.hexdigest()
