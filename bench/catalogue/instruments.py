"""The instruments of a run and their certificates, as rows of the catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.api.origin import instrument_name
from bench.catalogue.schema import key_of
from bench.files.bench.file import BenchFile
from bench.run.same_serial import NO_SERIAL

Row = dict[str, Any]


def instruments_of(bench: BenchFile | None, run: int, started: Mapping[str, Any]) -> dict[str, list[Row]]:
    """Return rows: what answered as a run `started`, as what it was used, under which certificates."""
    answered = {str(k): str(v) for k, v in (started.get("instruments") or {}).items()}
    serials = {str(k): str(v).strip() for k, v in (started.get("serials") or {}).items()}
    instruments: dict[int, Row] = {}
    certificates: dict[int, Row] = {}
    uses = []
    sections = {section.name: section for section in bench.instruments.all()} if bench else {}
    for role, identity in answered.items():
        section = sections.get(role)
        resource = text_of(getattr(section, "resource", None))
        serial = serials.get(role, "")
        if serial in NO_SERIAL:
            serial = ""
        name = instrument_name(identity, serial, resource, bench.name if bench else "an unknown bench")
        instrument = key_of("instrument", name)
        driver = text_of(getattr(section, "driver", None))
        instruments[instrument] = {"id": instrument, "name": name, "driver": driver, "serial": serial or None}
        certificate = None
        if (stated := getattr(section, "certificate", None)) is not None:
            row = _certificate(stated)
            certificate = row["id"]
            certificates[row["id"]] = row
        uses.append(
            {
                "run": run,
                "role": role,
                "instrument": instrument,
                "certificate": certificate,
                "answered": identity,
                "resource": resource,
            }
        )
    return {"instruments": [*instruments.values()], "certificates": [*certificates.values()], "uses": uses}


def _certificate(stated: Any) -> Row:
    row = {
        "number": stated.number,
        "laboratory": stated.laboratory,
        "date": stated.date,
        "valid_until": stated.valid_until,
        "serial": stated.serial,
    }
    return {"id": key_of("certificate", *(str(value) for value in row.values())), **row}


def text_of(value: Any) -> str | None:
    """Return a text or number as text, None for all else."""
    return str(value) if isinstance(value, str | int | float) and str(value) else None
