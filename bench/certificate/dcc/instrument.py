"""An instrument's certificate, out of its DCC, as the section that a bench file's traceability takes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import ValidationError

from bench.api.errors import Refused
from bench.certificate.dcc.lists import NotRead, RealList, real_lists
from bench.certificate.dcc.nodes import DCC, NAMESPACES, Node
from bench.certificate.dcc.reading import said
from bench.devices.certificates import ChamberCertificate, HeadCertificate

_ERROR: Final = "basic_measurementError"
_AXIS: Final = ("basic_nominalValue", "basic_referenceValue", "basic_measuredValue", "basic_indicatedValue")
"""Words of refType by which good practice of DCCs names columns."""


@dataclass(frozen=True)
class Section:
    """The text to be pasted, and what a reader should know of it."""

    text: str
    notes: tuple[str, ...]


def section_of(path: Path, root: Node) -> Section:
    """Return the section `certificate` of an instrument. Raises `Refused` for a document that says too little."""
    core = "dcc:administrativeData/dcc:coreData/dcc:{}"
    lab = "dcc:administrativeData/dcc:calibrationLaboratory/dcc:contact/dcc:name/dcc:content"
    stated: dict[str, Any] = {
        "number": said(root, core.format("uniqueIdentifier")),
        "laboratory": said(root, lab),
        "date": said(root, core.format("endPerformanceDate")),
    }
    lacking = [name for name, text in stated.items() if not text]
    if lacking:
        raise Refused(f"{path}: the document does not state its {', '.join(lacking)}")
    serial = _serial(root)
    if serial:
        stated["serial"] = serial
    values, notes = _values(path, root)
    text = yaml.safe_dump({"certificate": {**stated, **({"values": values} if values else {})}}, sort_keys=False,
                          allow_unicode=True, width=110)  # fmt: skip
    return Section(text, (*_checked(stated, values), *notes))


def _serial(root: Node) -> str:
    """Return the serial number of the item: what its manufacturer gave it."""
    for one in root.iterfind(".//dcc:item/dcc:identifications/dcc:identification", NAMESPACES):
        if one.findtext("dcc:issuer", "", NAMESPACES) == "manufacturer":
            return said(one, "dcc:value")
    return ""


def _values(path: Path, root: Node) -> tuple[list[dict[str, str]], list[str]]:
    """Return the rows of corrections, of the head's angles or of temperatures, and what is to be done by hand."""
    try:
        tables = list(_tables(root))
    except NotRead as error:
        raise Refused(f"{path}: {error}") from error
    rows: list[dict[str, str]] = []
    notes = []
    for axis, off in tables:
        kinds = set(axis.dimensions) | set(off.dimensions)
        if off.u is None:
            notes.append(f"{off.words}: without an uncertainty, and left out")
        elif kinds == {()}:
            rows += _rows("angle", "deg", "arcsec", axis, off, 180.0 / math.pi, 648000.0 / math.pi)
        elif kinds == {(("K", 1),)}:
            rows += _rows("temperature", "degC", "K", axis, off, 1.0, 1.0)
        else:
            notes.append(f"{off.words}: errors of another kind; write what they say by hand")
    if not tables:
        notes.append(
            f"no table of errors ({_ERROR} beside {_AXIS[0]}) was found: add 'values' by hand, from the paper"
        )
    return rows, notes


def _tables(root: Node) -> Iterator[tuple[RealList, RealList]]:
    """Yield each column of errors with the column that it belongs to."""
    for table in root.iter(f"{{{DCC}}}list"):
        columns = [
            one for quantity in table.findall("dcc:quantity", NAMESPACES) for one in real_lists(quantity)
        ]
        errors = [one for one in columns if _ERROR in one.roles]
        for word in _AXIS:
            axes = [one for one in columns if word in one.roles and all(one is not e for e in errors)]
            if errors and axes and len(axes[0].values) == len(errors[0].values):
                yield axes[0], errors[0]
                break


def _rows(
    key: str, unit: str, small: str, axis: RealList, error: RealList, per: float, per_small: float
) -> Iterator[dict[str, str]]:
    """Yield the rows: a correction is an error with the other sign; U with k = 2 of what is known of u."""
    u = error.u
    if u is None:
        return
    for at, off, size in zip(axis.values.tolist(), error.values.tolist(), u.tolist(), strict=True):
        yield {
            key: f"{round(at * per, 9):.9g} {unit}",
            "correction": f"{round(-off * per_small, 9) + 0.0:.9g} {small}",
            "U": f"{2.0 * size * per_small:.6g} {small}",
            "k": "2",
        }


def _checked(stated: dict[str, Any], values: list[dict[str, str]]) -> Iterator[str]:
    """Yield what a bench file would refuse of these values."""
    if not values:
        return
    form = HeadCertificate if "angle" in values[0] else ChamberCertificate
    try:
        form.model_validate({**stated, "values": values})
    except ValidationError as error:
        for one in error.errors()[:5]:
            yield f"a bench file does not take this as it is: {one['msg'].removeprefix('Value error, ')}"
