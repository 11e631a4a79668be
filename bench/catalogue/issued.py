"""The certificates that this laboratory issued, as rows of the catalogue: from the registers that a sync passes."""

from __future__ import annotations

from pathlib import Path

from bench.api.errors import Refused
from bench.catalogue.instruments import Row, text_of
from bench.catalogue.record import utc_of
from bench.catalogue.schema import key_of
from bench.certificate.register import Register


def issued_in(folder: str) -> list[Row]:
    """Return a row for each number of a register. Raises `Refused` for one that cannot be believed or read."""
    register = Register(Path(folder))
    try:
        register.read_lines()
    except OSError as error:
        raise Refused(f"the register cannot be read ({error.strerror})") from error
    rows = []
    for number, standing in register.standings.items():
        record = standing.entry.data.get("record")
        rows.append(
            {
                "id": key_of("issued", folder, number),
                "register": folder,
                "number": number,
                "time": utc_of(standing.entry.time),
                "state": standing.state,
                "by": standing.by or standing.entry.by or None,
                "run": text_of(standing.entry.data.get("run")),
                "head": text_of(record.get("head")) if isinstance(record, dict) else None,
            }
        )
    return rows
