"""The way back: coefficients of a block out of a DCC, ours or another's, as a result of a calibration has them."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from lxml import etree

from bench.api.coefficients import coefficients_of
from bench.api.errors import Refused
from bench.base.arrays import Floats
from bench.base.regular import read_regular
from bench.base.visible import visible
from bench.base.whole import from_text
from bench.certificate.dcc.lists import Dimension, NotRead, RealList, real_lists
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, SIGNATURE, Node
from bench.certificate.dcc.rules import parser
from bench.model.block import COEFFICIENTS

MOST_BYTES: Final = 64_000_000
OURS: Final = "bench_coefficients"
_FILE: Final = "result.json"

_VOLT: Final[Dimension] = (("V", 1),)
_VOLT_PER_MS2: Final[Dimension] = (("V", 1), ("m", -1), ("s", 2))


@dataclass(frozen=True)
class Read:
    """What a document says of a block: a result as `bench calibrate --json` has it, and what to know of it."""

    result: dict[str, Any]
    notes: tuple[str, ...]


def document_in(path: Path) -> tuple[Node, tuple[str, ...]]:
    """Return the root of a document, and what its signature is worth; of a signed one only what is signed.

    Raises `Refused` where it cannot be read, is no DCC, or where its signature does not hold.
    """
    try:
        content = read_regular(path, MOST_BYTES)
        if content.startswith(b"%PDF"):
            content = _attached(path, content)
        root = etree.fromstring(content, parser())
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({error.strerror})") from error
    except etree.XMLSyntaxError as error:
        raise Refused(
            f"{path}: not XML ({error}); give the XML of a digital calibration certificate, or the PDF that has it"
        ) from None
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise Refused(f"{path}: not a digital calibration certificate (DCC)")
    if root.find(f".//{{{SIGNATURE}}}Signature") is None:
        return root, ("nobody signed this document",)
    from bench.certificate.signature.signatory import name_of
    from bench.certificate.signature.xades import NotIntact, check_xml

    try:
        signed = check_xml(content)
    except NotIntact as error:
        raise Refused(f"{path}: {error}; nothing of it is read") from error
    who = name_of(signed.chain[0])
    note = f"signed as {who}, intact; whose key that is, 'bench certificate verify {path} --trust FILE' tells"
    return etree.fromstring(signed.content, parser()), (note,)


def _attached(path: Path, paper: bytes) -> bytes:
    """Return the XML in a certificate's PDF. Raises `Refused` where there is none, or more than one."""
    import pikepdf

    try:
        with pikepdf.open(BytesIO(paper)) as pdf:
            found = [pdf.attachments[name] for name in pdf.attachments if name.lower().endswith(".xml")]
            if len(found) == 1:
                return bytes(found[0].get_file().read_bytes())
    except (pikepdf.PdfError, KeyError, ValueError) as error:
        raise Refused(f"{path}: a PDF that cannot be read ({error})") from error
    raise Refused(
        f"{path}: {len(found) or 'no'} XML files are attached to this PDF; give the certificate's XML itself"
    )


def has_coefficients(root: Node) -> bool:
    """Whether a document has a list of the twelve coefficients."""
    words = (one.text or "" for one in root.iter(f"{{{SI}}}labelXMLList"))
    members = (
        " ".join(label.text or "" for label in one.iter(f"{{{SI}}}label"))
        for one in root.iter(f"{{{SI}}}realList")
    )
    return any(_order(tuple(text.split())) is not None for text in (*words, *members))


def coefficients_in(path: Path, g_m_s2: float | None = None, noise_v: float | None = None) -> Read:
    """Return the twelve coefficients of a document with their covariance.

    `g_m_s2` is the local gravity at which coefficients of another's document are to be stated, `noise_v` the noise
    of a reading, V: a certificate of ours tells both. Raises `Refused` where there are none, or more than one.
    """
    root, notes = document_in(path)
    try:
        lists = list(real_lists(root))
    except NotRead as error:
        raise Refused(f"{path}: {error}") from error
    own = [one for one in lists if {OURS, "bench_found"} <= one.roles and one.covariance is not None]
    if len(own) == 1:
        return Read(_ours(path, root, own[0]), notes)
    named = [(one, order) for one in lists if (order := _order(one.labels)) is not None]
    if not named:
        there = "; ".join(one.words for one in lists[:6]) or "none"
        raise Refused(
            f"{path}: no list of the twelve coefficients {COEFFICIENTS[0]} … {COEFFICIENTS[-1]}; its lists: {there}"
        )
    if len(named) > 1:
        with_covariance = [pair for pair in named if pair[0].covariance is not None]
        named = with_covariance if len(with_covariance) == 1 else named
    if len(named) > 1:
        raise Refused(f"{path}: more than one list of coefficients: {'; '.join(o.words for o, _ in named)}")
    return _others(path, root, *named[0], notes, g_m_s2, noise_v)


def _ours(path: Path, root: Node, listed: RealList) -> dict[str, Any]:
    """Return the result in a certificate of ours; its numbers are those of the list, or it is refused."""
    data = from_text(_file(path, root))
    taken = coefficients_of(data, str(path))
    if listed.covariance is None or not (
        np.array_equal(listed.values, taken.block.vector)
        and np.array_equal(listed.covariance, taken.covariance)
    ):
        raise Refused(f"{path}: {_FILE} in it states other coefficients than its list; it is not read")
    told = {name: value for name, value in data.items() if name != "verification"}
    return {**told, "certificate": _about(root)}


def _file(path: Path, root: Node) -> bytes:
    for one in root.iter(f"{{{DCC}}}byteData"):
        if one.findtext("dcc:fileName", "", NAMESPACES) == _FILE:
            try:
                return base64.b64decode(one.findtext("dcc:dataBase64", "", NAMESPACES), validate=True)
            except binascii.Error:
                break
    raise Refused(f"{path}: there is no {_FILE} in it that can be read")


def _about(root: Node) -> dict[str, str]:
    core = "dcc:administrativeData/dcc:coreData/dcc:{}"
    where = "dcc:administrativeData/dcc:calibrationLaboratory/dcc:contact/dcc:name/dcc:content"
    return {
        "number": said(root, core.format("uniqueIdentifier")),
        "laboratory": said(root, where),
        "date": said(root, core.format("endPerformanceDate")),
    }


def said(root: Node, path: str) -> str:
    """Return a text of a document in one line, with nothing in it that acts; empty where there is none."""
    return " ".join(visible(root.findtext(path, "", NAMESPACES)).split())


def _order(labels: tuple[str, ...]) -> tuple[int, ...] | None:
    """Return where each coefficient stands in a list with such labels; None where it is not one of them."""
    plain = [label.replace("_", "").replace("{", "").replace("}", "").casefold() for label in labels]
    wanted = [name.casefold() for name in COEFFICIENTS]
    if sorted(plain) != sorted(wanted):
        return None
    return tuple(plain.index(name) for name in wanted)


def _others(
    path: Path,
    root: Node,
    listed: RealList,
    order: tuple[int, ...],
    notes: tuple[str, ...],
    g_m_s2: float | None,
    noise_v: float | None,
) -> Read:
    """Return the coefficients of another's list as a result: K in V/g; what is unknown is asked for."""
    wanting = [] if g_m_s2 is not None else ["--g, the local gravity for which K is to be stated (m/s²)"]
    wanting += [] if noise_v is not None else ["--noise, the noise of a reading (V), which a check needs"]
    if g_m_s2 is None or noise_v is None:
        raise Refused(f"{path}: a certificate of another maker; say {' and '.join(wanting)}")
    dimensions = [listed.dimensions[i] for i in order]
    kinds = set(dimensions[:9])
    if kinds not in ({_VOLT}, {_VOLT_PER_MS2}) or set(dimensions[9:]) != {_VOLT}:
        raise Refused(
            f"{path}: {listed.words}: K is to be in \\volt (per local g) or "
            "\\volt\\metre\\tothe{-1}\\second\\tothe{2}, and U0 in \\volt"
        )
    scale = np.ones(12)
    if kinds == {_VOLT_PER_MS2}:
        scale[:9] = g_m_s2
        notes += (f"K was stated per m/s²: taken to local g = {g_m_s2:g} m/s²",)
    values = listed.values[list(order)] * scale
    covariance = listed.covariance
    if covariance is None:
        if listed.u is None:
            raise Refused(f"{path}: {listed.words}: it states no uncertainty")
        covariance = np.diag(listed.u**2)
        notes += (
            "it states no covariance: its coefficients are taken as not correlated, which they seldom are",
        )
    covariance = covariance[np.ix_(order, order)] * np.outer(scale, scale)
    result = _result(root, values, covariance, g_m_s2, noise_v)
    coefficients_of(result, str(path))
    return Read({**result, "notes": list(notes)}, notes)


def _result(
    root: Node, values: Floats, covariance: Floats, g_m_s2: float, noise_v: float
) -> Mapping[str, Any]:
    about = _about(root)
    u = np.sqrt(np.diag(covariance)).tolist()
    item = "dcc:administrativeData/dcc:items/dcc:item/dcc:{}"
    return {
        "estimator": "certificate",
        "unit": "V",
        "g_m_s2": g_m_s2,
        "per": "g",
        "coefficients": {
            name: {"value": value, "u": size, "U": 2.0 * size, "k": 2.0, "dof": None}
            for name, value, size in zip(COEFFICIENTS, values.tolist(), u, strict=True)
        },
        "order": list(COEFFICIENTS),
        "covariance": covariance.tolist(),
        "noise": {"reading_v": noise_v, "source": "as stated when the certificate was read"},
        "source": f"certificate {about['number']} of {about['laboratory']}",
        "made_at": about["date"],
        "unit_under_test": {
            "type": said(root, item.format("name/dcc:content")),
            "serial": said(root, item.format("identifications/dcc:identification/dcc:value")),
        },
        "simulated": False,
        "meters": [],
        "certificate": about,
    }
