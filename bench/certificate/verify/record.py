"""A certificate held against the laboratory's register and the record of its run, where these are at hand."""

from __future__ import annotations

import binascii
import hashlib
import json
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.files import read_regular
from bench.calibration import CalibrationError
from bench.calibration.conformity import SIMPLE, DecisionRule
from bench.certificate.content import Found
from bench.certificate.gather import found_by
from bench.certificate.register import ISSUED, LINES, Register
from bench.certificate.verify.shown import Shown
from bench.run.events import MANIFEST, RecordError, sha256
from bench.run.folder import find_run
from bench.run.seal import Seal
from bench.services.errors import Refused
from bench.services.verification import NOTHING_ASKED, Asked


@dataclass(frozen=True)
class Held:
    """What came of it: `wrong` says in what the other one differs, `told` what was held against it.

    `open` says what was not proved by it.
    """

    told: str = ""
    wrong: str = ""
    open: str = ""


def held_against_record(shown: Shown, runs: Path) -> Held | None:
    """Hold a certificate against its run among `runs`; None where that is not there, or is another of its name.

    The record is that of the certificate where it begins with the same inputs (`run.json`): then its chain must end
    as the seal says, and its readings must give the result: to the last digit on the computer that gave it first,
    within a small part of u on another, whose libraries round otherwise.
    """
    try:
        seal = Seal.from_json(json.loads(shown.files["seal.json"]))
        folder = runs / seal.run
        if not seal.run or Path(seal.run).name != seal.run or not folder.is_dir():
            return None
        run = find_run(seal.run, runs)
        differences = seal.differences(run)
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError, binascii.Error):
        return Held(wrong="the seal in the digital certificate cannot be read")
    except (RecordError, OSError):
        return None
    if seal.manifest_sha256 != sha256(read_regular(run.folder / MANIFEST)):
        return None
    if differences:
        return Held(wrong=f"{folder}: {'; '.join(differences)}")
    try:
        found = found_by(seal.run, runs, shown.coefficients[0].k, _asked(shown))
    except (Refused, RecordError, CalibrationError) as error:
        return Held(wrong=f"{folder}: the record gives no result ({error})")
    if found.result_json.encode() == shown.files["result.json"]:
        return Held(told=f"the record in {folder} is as it was, and gives the same result to the last digit")
    if _as_good_as(found, shown):
        return Held(
            told=f"the record in {folder} is as it was, and gives the same result within {_SAME:g} u, as another "
            "computer may round it"
        )
    if shown.release != metadata.version("triaxial-bench"):
        return Held(
            told=f"the record in {folder} is as it was",
            open=f"that the record gives these results: release {shown.release} evaluated it, another than this",
        )
    return Held(wrong=f"{folder}: the record gives another result than the certificate")


def _asked(shown: Shown) -> Asked:
    """Return the decision rule that the certificate states: it may have been agreed for it alone."""
    try:
        told = json.loads(shown.files["result.json"])["verification"]
        rule = DecisionRule.of_json(told) if told else DecisionRule()
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError):
        return NOTHING_ASKED  # its result is no result, which shows in what follows
    if rule.guard_band is None:
        return NOTHING_ASKED
    return Asked(rule=rule.name, guard_band=None if rule.name == SIMPLE else rule.guard_band)


_SAME: Final = 1e-6
"""Results that differ by no more, in units of u, are the same ones rounded otherwise."""


def _as_good_as(found: Found, shown: Shown) -> bool:
    """Whether coefficients, covariance and verdict of a record are those of a certificate but for rounding."""
    own = found.coefficients
    u = np.array([one.u for one in own.values])
    off = np.abs(
        [mine.value - theirs.value for mine, theirs in zip(own.values, shown.coefficients, strict=True)]
    )
    apart = np.abs(own.covariance - np.array(shown.covariance))
    same = bool(np.all(off <= _SAME * u) and np.all(apart <= _SAME * np.outer(u, u)))
    verdicts = [
        json.loads(text).get("verification") for text in (found.result_json, shown.files["result.json"])
    ]
    mine, theirs = (
        {name: (one or {}).get(name) for name in ("passed", "statement", "limit_g", "rule")}
        for one in verdicts
    )
    return same and mine == theirs


NOT_THERE: Final = "unknown"


@dataclass(frozen=True)
class Standing:
    """What the register in `folder` says: the state of a number, "unknown" where it has none; `by` what, or why.

    `named` tells that whoever asks named it, and not that it stands beside the file.
    """

    folder: str
    named: bool
    state: str
    by: str = ""

    @property
    def known(self) -> bool:
        """Whether the register has the number."""
        return self.state != NOT_THERE

    @property
    def holds(self) -> bool:
        """Whether the certificate was issued, and neither amended nor revoked."""
        return self.state == ISSUED

    @property
    def words(self) -> str:
        """What is said behind the verdict; nothing of a certificate that holds."""
        if self.holds:
            return ""
        return f", {self.state.upper()} ({self.by})" if self.known else ", UNKNOWN TO THE REGISTER"


def held_against_register(
    number: str, form: str, content: bytes, file: Path, folder: Path | None
) -> tuple[Standing | None, Held]:
    """Hold a form ("pdf", "xml") of a certificate against the register in `folder`, or where its file stands.

    None where no register is at hand: one that stands beside the file by chance, without the number, is none.
    Raises `Refused` for a register that cannot be believed or read.
    """
    place = file.absolute().parent if folder is None else folder
    if not (place / LINES).is_file():
        if folder is None:
            return None, Held()
        raise Refused(
            f"{place}: there is no register ({LINES}); nothing was issued with this laboratory file"
        )
    register = Register(place)
    try:
        register.read_lines()
    except OSError as error:
        raise Refused(f"{place}: cannot be read ({error.strerror})") from error
    known = register.standings.get(number)
    if known is None:
        return (None if folder is None else Standing(str(place), True, NOT_THERE)), Held()
    name = f"{number}.{form}"
    standing = Standing(str(place), folder is not None, known.state, known.by)
    if known.entry.files.get(name) != hashlib.sha256(content).hexdigest():
        return standing, Held(
            wrong=f"the register has another SHA-256 of {name}: this is not the issued file"
        )
    return standing, Held(told=f"the register in {place} has the SHA-256 of this file as that of {name}")
