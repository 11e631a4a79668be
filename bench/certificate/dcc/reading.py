"""Reading DCCs: what a certificate of ours says, the coefficients of a block, the certificates of instruments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from lxml import etree
from pydantic import ValidationError

from bench.base.arrays import Floats
from bench.base.files import from_text, read_regular
from bench.base.text import as_typed
from bench.base.units import VOLTAGE, parse_quantity
from bench.certificate.dcc.lists import Dimension, NotRead, RealList, files_in, real_lists, said
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, Node, tag
from bench.certificate.signatures import ORIGINAL, SIGNATURE, NoCertificate, NotIntact, check_xml, parser
from bench.config.devices.device import ChamberCertificate, HeadCertificate
from bench.model.geometry import COEFFICIENTS
from bench.results.certificate import CertificateSays, CertifiedCoefficient
from bench.services.coefficients import coefficients_of
from bench.services.errors import Refused, refusing

MOST_BYTES: Final = 64_000_000
OURS: Final = "bench_coefficients"
ROOT: Final = tag("dcc:digitalCalibrationCertificate")
_FILE: Final = "result.json"
_ABOUT: Final = "dcc:administrativeData"
_CORE: Final = f"{_ABOUT}/dcc:coreData"
_OWN_COEFFICIENTS: Final = (
    f"dcc:measurementResults/dcc:measurementResult/dcc:results/dcc:result[@refType='{OURS}']"
)

_VOLT: Final[Dimension] = (("V", 1),)
_VOLT_PER_MS2: Final[Dimension] = (("V", 1), ("m", -1), ("s", 2))


@dataclass(frozen=True)
class ShownValues:
    """The values in a certificate.

    `covariance` (n, n) is that of the coefficients, `files` maps names to attachments. `release` is the version of
    the program that wrote the certificate. `says_signed` is what the certificate says of itself: signed (True),
    unsigned (False) or nothing (None).
    """

    says: CertificateSays
    says_signed: bool | None
    release: str
    covariance: Floats
    files: dict[str, bytes]


def shown_of(content: bytes) -> ShownValues:
    """Return the values in an XML. Raises `NotIntact` if it is not a DCC or cannot be read completely."""
    root = etree.fromstring(content, parser())
    if root.tag != ROOT:
        raise NoCertificate("it is not a digital calibration certificate (DCC)")
    try:
        covariance, coefficients = _shown_coefficients(root)
        files = files_in(root)
    except NotRead as error:
        raise NotIntact(f"the digital certificate cannot be read ({error})") from error
    about = _about(root)
    persons = root.iterfind(f"{_ABOUT}/dcc:respPersons/dcc:respPerson", NAMESPACES)
    signers = (one for one in persons if said(one, "dcc:mainSigner") == "true")
    says = CertificateSays(
        number=about["number"],
        laboratory=about["laboratory"],
        customer=said(root, f"{_ABOUT}/dcc:customer/dcc:name/dcc:content"),
        items=[_item(one) for one in root.iterfind(f"{_ABOUT}/dcc:items/dcc:item", NAMESPACES)],
        calibrated=[said(root, f"{_CORE}/dcc:beginPerformanceDate"), about["date"]],
        issued=said(root, f"{_CORE}/dcc:issueDate"),
        authorised_by=next((said(one, "dcc:person/dcc:name/dcc:content") for one in signers), ""),
        conformity=said(root, ".//dcc:metaData[@refType='bench_conformity']/dcc:conformity"),
        simulated=_states(root, "simulated"),
        coefficients=coefficients,
        files=sorted(files),
    )
    says_signed = True if _states(root, "signed") else False if _states(root, "unsigned") else None
    release = said(root, f"{_ABOUT}/dcc:dccSoftware/dcc:software/dcc:release")
    return ShownValues(says, says_signed, release, covariance, files)


def _states(root: Node, ref: str) -> bool:
    """Return whether a document has this program's statement `ref`."""
    path = f"{_ABOUT}/dcc:statements/dcc:statement[@refType='bench_{ref}']"
    return root.find(path, NAMESPACES) is not None


def _item(item: Node) -> str:
    known = item.iterfind("dcc:identifications/dcc:identification", NAMESPACES)
    texts = (said(item, "dcc:name/dcc:content"), *(said(one, "dcc:value") for one in known))
    return ", ".join(filter(None, texts))


def _shown_coefficients(root: Node) -> tuple[Floats, dict[str, CertifiedCoefficient]]:
    """Return covariance and coefficients of the last result (unit as left), both empty without a result."""
    results = root.findall(_OWN_COEFFICIENTS, NAMESPACES)
    found = next(real_lists(results[-1]), None) if results else None
    if found is None:
        return np.empty((0, 0)), {}
    if found.covariance is None or found.uncertainty is None:
        raise NotRead(f"{found.words}: the list lacks its covariance or uncertainties")
    U, k = found.uncertainty
    if {len(found.labels), len(U), len(k)} != {len(found.values)}:
        raise NotRead(f"{found.words}: the counts of values, names and uncertainties differ")
    if not np.isfinite([found.values, U, k]).all():
        raise NotRead(f"{found.words}: a value or an uncertainty is not finite")
    columns = zip(found.values.tolist(), U.tolist(), k.tolist(), found.units, strict=True)
    return found.covariance, {
        label: CertifiedCoefficient(value=value, U=expanded, k=factor, unit=unit)
        for label, (value, expanded, factor, unit) in zip(found.labels, columns, strict=True)
    }


def document_in(path: Path) -> tuple[Node, tuple[str, ...]]:
    """Return the root of a DCC in XML or PDF, which may be signed, and a note on the signature.

    Raises `Refused` if the file cannot be read or is not intact.
    """
    try:
        with refusing("check name and permissions", path, verb="read"):
            content = read_regular(path, MOST_BYTES)
        if content.startswith(b"%PDF"):
            content = _attached(path, content)
        root = etree.fromstring(content, parser())
    except etree.XMLSyntaxError as error:
        raise Refused(
            f"{path}: not XML ({error}); give the XML of a digital calibration certificate, or the PDF that has it"
        ) from None
    if root.tag != ROOT:
        raise Refused(f"{path}: not a digital calibration certificate (DCC); give another file")
    if root.find(f".//{{{SIGNATURE}}}Signature") is None:
        return root, ("this document has no signature",)
    from bench.certificate.signatory import name_of

    try:
        signed = check_xml(content)
    except NotIntact as error:
        raise Refused(f"{path}: not read, as {error}; {ORIGINAL}") from error
    who = name_of(signed.chain[0])
    command = f"bench certificate verify {as_typed(path)} --trust FILE"
    note = f"signed as {who}, intact; whose key that is, '{command}' tells"
    return etree.fromstring(signed.content, parser()), (note,)


def _attached(path: Path, paper: bytes) -> bytes:
    """Return the only XML attached to a certificate's PDF. Raises `Refused` if there is none or several."""
    import pikepdf

    try:
        with pikepdf.open(BytesIO(paper)) as pdf:
            found = [pdf.attachments[name] for name in pdf.attachments if name.lower().endswith(".xml")]
            if len(found) == 1:
                return bytes(found[0].get_file().read_bytes())
    except (pikepdf.PdfError, KeyError, ValueError) as error:
        raise Refused(f"{path}: a PDF that cannot be read ({error}); check name and permissions") from error
    raise Refused(
        f"{path}: {len(found) or 'no'} XML files are attached to this PDF; give the certificate's XML itself"
    )


def has_coefficients(root: Node) -> bool:
    """Return whether a document has a list of quantities with the names of the twelve coefficients."""
    words = (one.text or "" for one in root.iter(f"{{{SI}}}labelXMLList"))
    members = (
        " ".join(label.text or "" for label in one.iter(f"{{{SI}}}label"))
        for one in root.iter(f"{{{SI}}}realList")
    )
    return any(_order(tuple(text.split())) is not None for text in (*words, *members))


def coefficients_in(
    path: Path, g_m_s2: float | None = None, noise: str | None = None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the result in a block's DCC, with the members of `bench calibrate --json`, and notes for the user.

    `g_m_s2` is the local gravity (m/s²) to which K shall refer, and `noise` the noise of a reading, such as
    "50 uV". Both are needed only if another program made the certificate. Raises `Refused` if the DCC has no
    list of the coefficients, or several.
    """
    try:
        noise_v = None if noise is None else parse_quantity(noise, VOLTAGE)
    except ValueError as error:
        raise Refused(f"--noise: {error}") from None
    root, notes = document_in(path)
    try:
        lists = list(real_lists(root))
    except NotRead as error:
        raise Refused(f"{path}: {error}; ask its laboratory to correct it") from error
    own = [one for one in lists if {OURS, "bench_found"} <= one.roles and one.covariance is not None]
    if len(own) == 1:
        return _ours(path, root, own[0]), notes
    named = [(one, order) for one in lists if (order := _order(one.labels)) is not None]
    if not named:
        there = "; ".join(one.words for one in lists[:6]) or "none"
        raise Refused(
            f"{path}: no list of the twelve coefficients (it has {there}); give a certificate that lists "
            f"{COEFFICIENTS[0]} to {COEFFICIENTS[-1]}"
        )
    if len(named) > 1:
        with_covariance = [pair for pair in named if pair[0].covariance is not None]
        named = with_covariance if len(with_covariance) == 1 else named
    if len(named) > 1:
        raise Refused(
            f"{path}: more than one list of coefficients; give a certificate with one: "
            f"{'; '.join(o.words for o, _ in named)}"
        )
    return _others(path, root, *named[0], notes, g_m_s2, noise_v)


def _ours(path: Path, root: Node, listed: RealList) -> dict[str, Any]:
    """Return the result in this program's certificate. Raises `Refused` if `listed` has other numbers."""
    try:
        data = from_text(files_in(root)[_FILE])
    except (NotRead, KeyError) as error:
        raise Refused(
            f"{path}: the certificate has no readable {_FILE}; ask the laboratory for the original"
        ) from error
    taken = coefficients_of(data, str(path))
    if listed.covariance is None or not (
        np.array_equal(listed.values, taken.block.vector)
        and np.array_equal(listed.covariance, taken.covariance)
    ):
        raise Refused(
            f"{path}: {_FILE} and the list of the certificate state different coefficients; ask the laboratory "
            "for the original"
        )
    told = {name: value for name, value in data.items() if name != "verification"}
    return {**told, "certificate": _about(root)}


def _about(root: Node) -> dict[str, str]:
    return {
        "number": said(root, f"{_CORE}/dcc:uniqueIdentifier"),
        "laboratory": said(root, f"{_ABOUT}/dcc:calibrationLaboratory/dcc:contact/dcc:name/dcc:content"),
        "date": said(root, f"{_CORE}/dcc:endPerformanceDate"),
    }


def _order(labels: tuple[str, ...]) -> tuple[int, ...] | None:
    """Return the index in `labels` of each coefficient; None unless the labels are the twelve names."""
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
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the result, with K in V/g, made from the coefficients that another program's document `listed`.

    Raises `Refused` if gravity or noise are not given, or if the units or uncertainties in the list do not
    suffice.
    """
    wanting = [] if g_m_s2 is not None else ["--g, the local gravity for which K is to be stated (m/s²)"]
    wanting += [] if noise_v is not None else ["--noise, the noise of a reading (V), which a check needs"]
    if g_m_s2 is None or noise_v is None:
        raise Refused(
            f"{path}: the certificate, of another program, does not state everything; give "
            f"{' and '.join(wanting)}"
        )
    dimensions = [listed.dimensions[i] for i in order]
    kinds = set(dimensions[:9])
    if kinds not in ({_VOLT}, {_VOLT_PER_MS2}) or set(dimensions[9:]) != {_VOLT}:
        raise Refused(
            f"{path}: {listed.words}: K or U0 has a unit that no block has; ask the laboratory for K in \\volt "
            "(per local g) or \\volt\\metre\\tothe{{-1}}\\second\\tothe{{2}}, and for U0 in \\volt"
        )
    scale = np.ones(12)
    if kinds == {_VOLT_PER_MS2}:
        scale[:9] = g_m_s2
        notes += (f"K was stated per m/s²: taken to local g = {g_m_s2:g} m/s²",)
    values = listed.values[list(order)] * scale
    covariance = listed.covariance
    if covariance is None:
        if listed.u is None:
            raise Refused(
                f"{path}: {listed.words}: the list states no uncertainty; ask its laboratory for one"
            )
        covariance = np.diag(listed.u**2)
        notes += ("it states no covariance; its coefficients are assumed uncorrelated, which is seldom true",)
    covariance = covariance[np.ix_(order, order)] * np.outer(scale, scale)
    result = _result(root, values, covariance, g_m_s2, noise_v)
    coefficients_of(result, str(path))
    return {**result, "notes": list(notes)}, notes


def _result(
    root: Node, values: Floats, covariance: Floats, g_m_s2: float, noise_v: float
) -> Mapping[str, Any]:
    about = _about(root)
    u = np.sqrt(np.diag(covariance)).tolist()
    item = f"{_ABOUT}/dcc:items/dcc:item"
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
            "type": said(root, f"{item}/dcc:name/dcc:content"),
            "serial": said(root, f"{item}/dcc:identifications/dcc:identification/dcc:value"),
        },
        "simulated": False,
        "meters": [],
        "certificate": about,
    }


_ERROR: Final = "basic_measurementError"
_AXIS: Final = ("basic_nominalValue", "basic_referenceValue", "basic_measuredValue", "basic_indicatedValue")
"""Words of refType that mark the column of a table to whose values the errors apply, by good practice of DCCs."""


def section_of(path: Path, root: Node) -> tuple[str, tuple[str, ...]]:
    """Return an instrument's section `certificate` for a bench file, as its DCC states it, and notes.

    Raises `Refused` if the DCC has no number or no date.
    """
    stated: dict[str, Any] = {**_about(root)}
    lacking = [name for name, text in stated.items() if not text]
    if lacking:
        raise Refused(
            f"{path}: the document does not state its {', '.join(lacking)}; ask its laboratory to add it"
        )
    serial = _serial(root)
    if serial:
        stated["serial"] = serial
    values, notes = _values(path, root)
    text = yaml.safe_dump({"certificate": {**stated, **({"values": values} if values else {})}}, sort_keys=False,
                          allow_unicode=True, width=110)  # fmt: skip
    return text, (*_checked(stated, values), *notes)


def _serial(root: Node) -> str:
    """Return the serial number that the manufacturer gave to the item; "" if there is none."""
    for one in root.iterfind(".//dcc:item/dcc:identifications/dcc:identification", NAMESPACES):
        if one.findtext("dcc:issuer", "", NAMESPACES) == "manufacturer":
            return said(one, "dcc:value")
    return ""


def _values(path: Path, root: Node) -> tuple[list[dict[str, str]], list[str]]:
    """Return rows of corrections (deg and arcsec, or degC and K), and notes on tables to be copied by hand."""
    try:
        tables = list(_tables(root))
    except NotRead as error:
        raise Refused(f"{path}: {error}; ask its laboratory to correct it") from error
    rows: list[dict[str, str]] = []
    notes = []
    for axis, off in tables:
        kinds = set(axis.dimensions) | set(off.dimensions)
        if off.u is None:
            notes.append(f"{off.words}: without an uncertainty; left out")
        elif kinds == {()}:
            rows += _rows("angle", "deg", "arcsec", axis, off, 180.0 / math.pi, 648000.0 / math.pi)
        elif kinds == {(("K", 1),)}:
            rows += _rows("temperature", "degC", "K", axis, off, 1.0, 1.0)
        else:
            notes.append(f"{off.words}: errors of another kind; enter them by hand")
    if not tables:
        notes.append(
            f"no table of errors ({_ERROR} beside {_AXIS[0]}) was found: add 'values' by hand, from the "
            "printed certificate"
        )
    return rows, notes


def _tables(root: Node) -> Iterator[tuple[RealList, RealList]]:
    """Yield two lists for each table: the values on its axis, and the errors at these values."""
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
    """Yield a row for each error in a table: the correction (the negated error) with U for k = 2.

    `per` converts values on the axis from SI to `unit`; `per_small` converts errors from SI to `small`.
    """
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
    """Yield a sentence for each reason, at most five, why a bench file cannot contain these values unchanged."""
    if not values:
        return
    form = HeadCertificate if "angle" in values[0] else ChamberCertificate
    try:
        form.model_validate({**stated, "values": values})
    except ValidationError as error:
        for one in error.errors()[:5]:
            yield f"a bench file cannot use this unchanged: {one['msg'].removeprefix('Value error, ')}"
