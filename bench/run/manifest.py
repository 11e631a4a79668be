"""What a run was begun with (`run.json`), and the error of a run that cannot be written or believed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Final, TypedDict, cast

from bench.base.files import read_regular

EVENTS: Final = "events.jsonl"
MANIFEST: Final = "run.json"
FORMAT: Final = 1


class UnitUnderTest(TypedDict):
    """The block that a run measures."""

    type: str
    serial: str


class VerdictAsked(TypedDict, total=False):
    """How the run's verdict is found, where that was asked for in place of the bench file's."""

    limit_g: float
    rule: str
    guard_band: float


class DefaultRule(TypedDict):
    """The decision rule of a run for which nobody states one, with the probability that sets its guard band."""

    rule: str
    false_acceptance: float


DEFAULT_RULE: Final[DefaultRule] = {"rule": "non-binary", "false_acceptance": 0.05}
"""The default as each record keeps it: one that has none was begun when simple acceptance was the default."""


class CheckedBefore(TypedDict, total=False):
    """What the check block said as the run began: `run` of the check block, how old, what the `rule` is.

    `state` is in control, out of control, too old or missing, `said` the same in words; `despite` is why the run
    was begun all the same, where the state spoke against it.
    """

    rule: str
    state: str
    said: str
    run: str
    age_h: float
    despite: str


class Manifest(TypedDict, total=False):
    """What a run was begun with (`run.json`), in this order; `files` are the SHA-256 of the inputs by name.

    `seed` is None for a run on real instruments. A run of a readings file (`imported`) says how many
    `readings` that has, and nothing of a procedure. `living` is a dry run whose questions a person answers.
    `bench_why` says why that bench file was taken. `devices` says
    where those drivers came from that are none of the bench's own, `verdict` how it is judged in place of the bench
    file's, `default_rule` how where neither says it, `until` the goals at which it ends, `check_block` what that
    said; all are left out where there is nothing.
    """

    format: int
    name: str
    created: str
    imported: str
    readings: int
    dry_run: bool
    seed: int | None
    living: bool
    operator: str
    procedure: str
    bench: str
    bench_why: str
    plan_hash: str
    unit_under_test: UnitUnderTest
    versions: dict[str, str]
    devices: dict[str, str]
    default_rule: DefaultRule
    verdict: VerdictAsked
    until: list[str]
    check_block: CheckedBefore
    files: dict[str, str]


class RecordError(Exception):
    """A run folder that cannot be written or believed; the text says where, why and what to do."""


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Return the inputs' manifest of a run. Raises `RecordError` when there is none."""
    try:
        manifest = json.loads(read_regular(folder / MANIFEST).decode())
    except (FileNotFoundError, NotADirectoryError):
        raise RecordError(f"{folder}: not a run (no {MANIFEST} in it)") from None
    except OSError as error:
        raise RecordError(f"{folder / MANIFEST}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise RecordError(f"{folder / MANIFEST}: damaged, not JSON; take it from a copy of the run") from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("files", {}), dict):
        raise RecordError(f"{folder / MANIFEST}: damaged, not a manifest; take it from a copy of the run")
    return cast(Manifest, manifest)


def changed_inputs(folder: Path) -> list[str]:
    """Say which of the inputs of a run are not what its manifest says. Raises `RecordError` without a manifest."""
    return [
        f"{name} was changed since the run began"
        for name, digest in read_manifest(folder).get("files", {}).items()
        if not (folder / name).is_file() or sha256(read_regular(folder / name)) != digest
    ]
