"""A certificate held against the record of its run, where that is at hand."""

from __future__ import annotations

import binascii
import json
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from bench.analysis.calibration import CalibrationError
from bench.api.errors import Refused
from bench.base.regular import read_regular
from bench.certificate.gather import found_by
from bench.certificate.verify.shown import Shown
from bench.run.folder import find_run
from bench.run.manifest import MANIFEST, RecordError, sha256
from bench.run.seal import Seal


@dataclass(frozen=True)
class Held:
    """What came of it: `wrong` says in what the record is another, `told` what was held against it.

    `open` says what was not proved by it.
    """

    told: str = ""
    wrong: str = ""
    open: str = ""


def held_against_record(shown: Shown, runs: Path) -> Held | None:
    """Hold a certificate against its run among `runs`; None where that is not there, or is another of its name.

    The record is that of the certificate where it begins with the same inputs (`run.json`): then its chain must end
    as the seal says, and its readings must give the result to the last digit.
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
        found = found_by(seal.run, runs, shown.coefficients[0].k)
    except (Refused, RecordError, CalibrationError) as error:
        return Held(wrong=f"{folder}: the record gives no result ({error})")
    if found.result_json.encode() == shown.files["result.json"]:
        return Held(
            told=f"the record in {folder} is what was sealed, and gives the same result to the last digit"
        )
    if shown.release != metadata.version("triaxial-bench"):
        return Held(
            told=f"the record in {folder} is what was sealed",
            open=f"that the record gives these results: release {shown.release} evaluated it, another than this",
        )
    return Held(wrong=f"{folder}: the record gives another result than the certificate")
