"""The records of the trial with their truth, sealed by hash."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from bench.config.foreign_log import LogColumns, convert_log
from bench.readings.csv import read_csv
from bench.readings.table import Readings

ROOT: Final = Path(__file__).parents[2]
TRUTH: Final = Path(__file__).with_name("truth.yaml")
SEALED: Final = Path(__file__).with_name("sealed.json")


@dataclass(frozen=True)
class Case:
    """A record: a log with its columns, or files of free positions; the publisher's statement, and the right names.

    `seen` marks a record that was used while this part of the program was written.
    """

    title: str
    told: str
    right: Sequence[str]
    file: str = ""
    columns: Mapping[str, Any] | None = None
    constants: Mapping[str, str] | None = None
    free: Sequence[str] = ()
    seen: bool = False

    @property
    def files(self) -> list[Path]:
        """The files of the case, in order."""
        patterns = self.free or [self.file]
        return [path for pattern in patterns for path in sorted(ROOT.glob(pattern))]

    def readings(self, folder: Path) -> Readings:
        """Return the readings of a log, by way of a readings file in `folder`."""
        constants = {"installation": "R", **(self.constants or {})}
        mapping = LogColumns.model_validate(
            {"log_columns": "1", "columns": self.columns, "constants": constants}
        )
        (log,) = self.files
        file = folder / "record.csv"
        file.write_text(convert_log(log, log.read_bytes(), mapping).text, encoding="utf-8")
        return read_csv(file, ())


def cases() -> list[Case]:
    """Return the cases that `truth.yaml` lists."""
    return [Case(**entry) for entry in yaml.safe_load(TRUTH.read_text(encoding="utf-8"))["records"]]


def hashes() -> dict[str, str]:
    """Return the SHA-256 of the truth and of each file of the records."""
    files = [TRUTH, *dict.fromkeys(file for case in cases() for file in case.files)]
    return {
        file.relative_to(ROOT).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files
    }


def seal() -> None:
    """Write the hashes, once, before the first run."""
    SEALED.write_text(json.dumps(hashes(), indent=1) + "\n", encoding="utf-8")


def require_sealed() -> None:
    """Raise `SystemExit` if the truth or a record differs from the sealed one."""
    if json.loads(SEALED.read_text(encoding="utf-8")) != hashes():
        raise SystemExit("benchmarks/real_records: truth or records are not those that were sealed")
