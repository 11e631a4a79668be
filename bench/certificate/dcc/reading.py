"""Reading of DCCs: this program's certificates, the coefficients of a block, the certificates of instruments."""

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
from bench.base.languages import message
from bench.base.text import as_typed
from bench.base.units import VOLTAGE, parse_quantity
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, Node, tag
from bench.certificate.dcc.rules import Dimension, NotRead, RealList, files_in, real_lists, said
from bench.certificate.register import ISSUED, REVOKED, Register
from bench.certificate.signatures import ORIGINAL, SIGNATURE, NoCertificate, NotIntact, check_xml, parser
from bench.config.devices.device import Certificate, ChamberCertificate, HeadCertificate, VoltmeterCertificate
from bench.model.geometry import COEFFICIENTS
from bench.results.certificate import CertificateSays, CertifiedCoefficient
from bench.services.chain import LINES
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

    `covariance` (n, n) belongs to the coefficients, `files` maps names to attachments. `release` is the version of
    the program that wrote the certificate. `says_signed` is True if the certificate calls itself signed,
    False if it calls itself unsigned, and None if it says neither.
    """

    says: CertificateSays
    says_signed: bool | None
    release: str
    covariance: Floats
    files: dict[str, bytes]


def shown_of(content: bytes) -> ShownValues:
    """Return the values in a certificate's XML. Raises `NotIntact` if it is no DCC or cannot be read completely."""
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
    """Return the root of a DCC in XML or PDF, which may be signed, and notes on its signature and validity.

    Raises `Refused` if the file cannot be read or is not intact.
    """
    try:
        with refusing("check name and permissions", path, reading=True):
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
        return root, (message("this document has no signature"), *_why_not_valid(path, root))
    from bench.certificate.signatory import name_of, why_not_trusted

    try:
        signed = check_xml(content)
        if unfit := why_not_trusted(signed.chain, signed.signed_at, None):
            raise NotIntact(unfit)
    except NotIntact as error:
        raise Refused(f"{path}: not read, as {error}; {ORIGINAL}") from error
    who = name_of(signed.chain[0])
    command = f"bench certificate verify {as_typed(path)} --trust FILE"
    note = f"signed as {who}, intact; whose key that is, '{command}' tells"
    root = etree.fromstring(signed.content, parser())
    return root, (note, *_why_not_valid(path, root))


def _why_not_valid(path: Path, root: Node) -> tuple[str, ...]:
    """Return a sentence if the register beside a certificate has it as revoked or superseded, or is damaged."""
    place, number = path.absolute().parent, said(root, f"{_CORE}/dcc:uniqueIdentifier")
    try:
        status = Register(place).read_lines().standings.get(number) if (place / LINES).is_file() else None
    except Refused as reason:
        return (f"not known to be valid: {reason}",)
    if status is None or status.state == ISSUED:
        return ()
    if status.state == REVOKED:
        return (message(f"the register in {place} has {number} as revoked ({status.by}): do not use it"),)
    return (
        message(
            f"the register in {place} has {number} as {status.state} by {status.by}: use that certificate"
        ),
    )


def _attached(path: Path, paper: bytes) -> bytes:
    """Return the only XML attached to a certificate's PDF. Raises `Refused` if there is none or several."""
    import pikepdf

    try:
        with pikepdf.open(BytesIO(paper)) as pdf:
            found = [pdf.attachments[name] for name in pdf.attachments if name.lower().endswith(".xml")]
            if len(found) == 1:
                return bytes(found[0].get_file().read_bytes())
    except (pikepdf.PdfError, KeyError, ValueError) as error:
        raise Refused(f"{path}: a PDF that cannot be read ({error}); {ORIGINAL}") from error
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
    """Return the result in a block's DCC, in the form of `bench calibrate --json`, and notes for the user.

    `g_m_s2` is the local gravity (m/s²) of its laboratory, and `noise` the standard deviation of a
    reading, such as "50 uV". Both are needed only if another program made the certificate. Raises `Refused`
    if the DCC has no list of the coefficients, or several.
    """
    try:
        noise_v = None if noise is None else parse_quantity(noise, VOLTAGE)
    except ValueError as error:
        raise Refused(f"--noise: {error}") from None
    if noise_v is not None and noise_v < 0.0:
        raise Refused(f"--noise {noise}: the noise is negative; give 0 or more, such as '50 uV'")
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
    """Return the result, with K in V/g, made from the coefficients `listed` in another program's document.

    `order` has the index in `listed` of each coefficient. Raises `Refused` if gravity or noise are not given, or if
    the units or uncertainties in the list do not suffice.
    """
    wanting = [] if g_m_s2 is not None else ["--g, the local gravity of its laboratory (m/s²)"]
    wanting += [] if noise_v is not None else ["--noise, the noise of a reading (V), which a check needs"]
    if g_m_s2 is None or noise_v is None:
        raise Refused(
            f"{path}: the certificate is of another program and lacks data; give {' and '.join(wanting)}"
        )
    dimensions = [listed.dimensions[i] for i in order]
    kinds = set(dimensions[:9])
    if kinds not in ({_VOLT}, {_VOLT_PER_MS2}) or set(dimensions[9:]) != {_VOLT}:
        raise Refused(
            f"{path}: {listed.words}: K or U0 has a unit that no block has; ask the laboratory for K in V "
            "(per local g) or V/(m/s²), and for U0 in V"
        )
    scale = np.ones(12)
    if kinds == {_VOLT_PER_MS2}:
        scale[:9] = g_m_s2
        notes += (f"K was stated per m/s²: taken to local g = {g_m_s2:g} m/s²",)
    else:
        notes += (f"K is in V: taken as per local g of its laboratory, {g_m_s2:g} m/s²",)
    values = listed.values[list(order)] * scale
    covariance = listed.covariance
    if covariance is None:
        if listed.u is None:
            raise Refused(
                f"{path}: {listed.words}: the list states no uncertainty; ask its laboratory for one"
            )
        covariance = np.diag(listed.u**2)
        notes += ("it states no covariance; its coefficients are assumed uncorrelated, which is seldom true",)
    notes += ("it states no K2 and K3 of the block: above 1 g, u of an acceleration lacks them",)
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
    """Return a section `certificate` (YAML) for an instrument in a bench file, and notes for the user.

    `root` is the instrument's DCC. Raises `Refused` if it lacks number, laboratory or date, or violates D-SI.
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


def _values(path: Path, root: Node) -> tuple[list[dict[str, Any]], list[str]]:
    """Return rows of corrections of angles, temperatures or voltages, and notes on what must be copied by hand."""
    try:
        tables = list(_tables(root))
    except NotRead as error:
        raise Refused(f"{path}: {error}; ask its laboratory to correct it") from error
    found: dict[str, list[list[dict[str, Any]]]] = {}
    notes = []
    for table in tables:
        kind = table.kind
        if table.error.u is None:
            notes.append(f"{table.error.words}: without an uncertainty; left out")
        elif kind == "voltage" and table.range is None:
            notes.append(f"{table.error.words}: no column states the range; enter them by hand")
        elif kind:
            rows = table.by_range() if kind == "voltage" else table.by_point()
            found.setdefault(kind, []).append(list(rows))
        else:
            notes.append(f"{table.error.words}: errors of another kind; enter them by hand")
    kept = [rows for kind, each in found.items() for rows in each if len(each) == 1 or kind == "voltage"]
    if len(found) > 1 or len(kept) < sum(map(len, found.values())):
        notes.append(
            "more than one table of errors, such as before and after an adjustment: enter one by hand"
        )
        kept = []
    if not tables:
        notes.append(
            f"no table of errors ({_ERROR} beside {_AXIS[0]}) was found: add 'values' by hand, from the "
            "printed certificate"
        )
    return [row for rows in kept for row in rows], notes


@dataclass(frozen=True)
class _Table:
    """A table of errors: the values on its axis, the errors at these values, and the instrument's ranges, if any.

    `alternating` means that a column states frequencies.
    """

    axis: RealList
    error: RealList
    range: RealList | None
    alternating: bool

    @property
    def kind(self) -> str:
        """The kind of quantity: "angle", "temperature", "voltage", or "" for another one or a mixture."""
        kinds = {_kind(unit, one) for lists in (self.axis, self.error)
                 for unit, one in zip(lists.units, lists.dimensions, strict=True)}  # fmt: skip
        return kinds.pop() if len(kinds) == 1 and not self.alternating else ""

    @property
    def u(self) -> Floats:
        """The standard uncertainties of the errors in SI units, shape (n,)."""
        u = np.empty(0) if self.error.u is None else self.error.u
        return np.broadcast_to(u, self.error.values.shape)

    def by_point(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each angle or temperature: the correction (the negated error) with U for k = 2."""
        axis, small, per, per_small = _SMALL[self.kind]
        zero = np.array([_KELVIN_OF_0_C if unit.endswith(r"\kelvin") else 0.0 for unit in self.axis.units])
        for at, off, size in zip(self.axis.values - zero, self.error.values, self.u, strict=True):
            yield {
                self.kind: f"{round(at * per, 9):.9g} {axis}",
                "correction": f"{round(-off * per_small, 9) + 0.0:.9g} {small}",
                "U": f"{2.0 * size * per_small:.6g} {small}",
                "k": "2",
            }

    def by_range(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each range of a voltmeter: the line through the errors of its points, negated.

        The correlation of the errors is not known, so u is the larger of the u for independent errors and the u for
        a common error. For independent errors, it is the u of the fitted line. For a common error, u of the gain is
        the largest u/|V| of the points with at least half of the largest |V|, and u of the offset is the u of the
        point nearest zero. The largest deviation from the line is added in quadrature. Points at one voltage give
        the gain alone; at 0 V they give the offset alone.
        """
        if self.range is None:
            return
        of_each = np.broadcast_to(self.range.values, self.axis.values.shape)
        for size in np.unique(of_each):
            at, off, u = (one[of_each == size] for one in (self.axis.values, self.error.values, self.u))
            top, one_v = np.max(np.abs(at)), np.ptp(at) == 0.0
            terms = np.stack([at**power for power in ((0,) if top == 0.0 else (1,) if one_v else (0, 1))])
            solve = np.linalg.pinv(terms.T)
            line, alone = solve @ off, np.sqrt(solve**2 @ u**2)
            left = np.max(np.abs(off - line @ terms))
            row: dict[str, Any] = {"range": f"{size:.9g} V"}
            if top > 0.0:
                high = np.abs(at) >= top / 2.0
                common = np.max(u[high] / np.abs(at[high]))
                row["gain"] = _certified(line[-1], np.hypot(max(alone[-1], common), left / top), "ppm")
            if top == 0.0 or not one_v:
                common = u[np.argmin(np.abs(at))]
                row["offset"] = _certified(line[0], np.hypot(max(alone[0], common), left), "uV")
            yield row


def _certified(error: float, u: float, unit: str) -> dict[str, str]:
    """Return a correction with U for k = 2, in millionths of V/V or V."""
    return {
        "correction": f"{round(-1e6 * error, 6) + 0.0:.9g} {unit}",
        "U": f"{2e6 * u:.6g} {unit}",
        "k": "2",
    }


_KELVIN_OF_0_C: Final = 273.15
_SMALL: Final = {
    "angle": ("deg", "arcsec", 180.0 / math.pi, 648000.0 / math.pi),
    "temperature": ("degC", "K", 1.0, 1.0),
}
"""The kinds of corrections by point: units of axis and correction, and factors from SI to them."""


def _kind(unit: str, dimension: Dimension) -> str:
    """Return the kind of a quantity. A number without dimension is an angle only if its unit measures angles."""
    if not dimension and unit.rpartition("\\")[2] in {"degree", "arcminute", "arcsecond", "radian"}:
        return "angle"
    return {(("K", 1),): "temperature", _VOLT: "voltage"}.get(dimension, "")


def _tables(root: Node) -> Iterator[_Table]:
    """Yield the tables of errors of a document; if a quantity is listed in two units, the first list counts."""
    for table in root.iter(f"{{{DCC}}}list"):
        columns = [
            one for quantity in table.findall("dcc:quantity", NAMESPACES) for one in real_lists(quantity)
        ]
        errors = [one for one in columns if _ERROR in one.roles]
        others = [one for one in columns if _ERROR not in one.roles and not one.roles & set(_AXIS)]
        ranges = [one for one in others if set(one.dimensions) == {_VOLT}
                  and any(word.lower().endswith("range") for word in one.roles)]  # fmt: skip
        alternating = any(set(one.dimensions) == {(("s", -1),)} for one in others)
        for word in _AXIS:
            axes = [one for one in columns if word in one.roles and all(one is not e for e in errors)]
            if errors and axes and len(axes[0].values) == len(errors[0].values):
                fits = {1, len(axes[0].values)}
                of_range = next((one for one in ranges if len(one.values) in fits), None)
                yield _Table(axes[0], errors[0], of_range, alternating)
                break


def _checked(stated: dict[str, Any], values: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a sentence for each reason, at most five, why a bench file cannot contain these values unchanged."""
    if not values:
        return
    forms: dict[str, type[Certificate]] = {
        "angle": HeadCertificate,
        "temperature": ChamberCertificate,
        "range": VoltmeterCertificate,
    }
    form = forms[next(iter(values[0]))]
    try:
        form.model_validate({**stated, "values": values})
    except ValidationError as error:
        for one in error.errors()[:5]:
            yield f"a bench file cannot use this unchanged: {one['msg'].removeprefix('Value error, ')}"
