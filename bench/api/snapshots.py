"""Calibrations as they are compared with one another, from results of `bench calibrate --json`."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.analysis.history.comparison import Snapshot
from bench.api.coefficients import coefficients_of
from bench.api.errors import Refused
from bench.base.regular import read_given
from bench.base.whole import from_text


def snapshots_in(path: Path) -> list[Snapshot]:
    """Return the calibrations in a result of `calibrate --json`. Raises `Refused` where it is none."""
    try:
        data = from_text(read_given(path).decode())
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({error.strerror}); check the name") from error
    except ValueError as error:
        raise Refused(f"{path}: not a result of 'bench calibrate --json' ({error})") from error
    results = data if isinstance(data, list) else [data]
    return [_from_result(result, path, k if len(results) > 1 else 0) for k, result in enumerate(results, 1)]


def _from_result(data: Any, path: Path, number: int) -> Snapshot:
    name = f"{path}, result {number}" if number else str(path)
    found = coefficients_of(data, name)
    block = data.get("unit_under_test")
    if not isinstance(block, dict):
        block = {}
    return Snapshot(
        name,
        date_of(data.get("made_at"), name),
        f"{block.get('type', '')} {block.get('serial', '')}".strip(),
        found.unit,
        found.g_m_s2,
        found.block.vector,
        found.covariance,
        found.simulated,
        found.same_meters,
        found.meters,
        found.block_terms,
        found.wander,
    )


def date_of(text: str | None, where: str) -> datetime | None:
    """Return a date as it is written (ISO 8601), in UTC where it names no zone. Raises `Refused`."""
    if not text:
        return None
    try:
        date = datetime.fromisoformat(text)
    except (ValueError, TypeError):
        raise Refused(f"{where}: expected a date such as 2026-01-31, got {text!r}") from None
    return date if date.tzinfo else date.replace(tzinfo=UTC)
