"""What a signed digital certificate says, read from the signed content and from nothing else."""

from __future__ import annotations

import base64
import binascii
import math
from dataclasses import dataclass
from typing import Any, Final

from bench.certificate.signatures import NoCertificate, NotIntact
from bench.results.certificate import CertificateSays

_DCC: Final = "https://ptb.de/dcc"
_NAMES: Final = {"dcc": _DCC, "si": "https://ptb.de/si"}
_ROOT: Final = f"{{{_DCC}}}digitalCalibrationCertificate"
_CORE: Final = "dcc:administrativeData/dcc:coreData"
_RESULTS: Final = "dcc:measurementResults/dcc:measurementResult/dcc:results/dcc:result"
_COEFFICIENTS: Final = f"{_RESULTS}[@refType='bench_coefficients']"

_LIST: Final = ".//si:realListXMLList"


@dataclass(frozen=True)
class Coefficient:
    """A coefficient as it was signed: value, U = k u, k, unit (D-SI)."""

    name: str
    value: float
    U: float
    k: float
    unit: str


@dataclass(frozen=True)
class Shown:
    """What a certificate says: `files` are those that it holds, `covariance` that of the coefficients, row by row.

    `conformity` is the word of the DCC ("pass"), empty where it makes no statement; `release` is that of the
    program that made it; `says_signed` whether it says that it is signed, None where it says nothing of that.
    """

    number: str
    laboratory: str
    customer: str
    items: tuple[str, ...]
    calibrated: tuple[str, str]
    issued: str
    authorised_by: str
    conformity: str
    simulated: bool
    says_signed: bool | None
    release: str
    coefficients: tuple[Coefficient, ...]
    covariance: tuple[tuple[float, ...], ...]
    files: dict[str, bytes]

    def part(self) -> CertificateSays:
        """Return it as a result has it, the files by their names alone."""
        told = {name: getattr(self, name) for name in CertificateSays.model_fields}
        coefficients = {
            one.name: {"value": one.value, "U": one.U, "k": one.k, "unit": one.unit}
            for one in self.coefficients
        }
        return CertificateSays.model_validate(
            {
                **told,
                "items": list(self.items),
                "calibrated": list(self.calibrated),
                "coefficients": coefficients,
                "files": sorted(self.files),
            }
        )


def shown_of(content: bytes) -> Shown:
    """Return what content says. Raises `NotIntact` where it is no digital calibration certificate."""
    from lxml import etree

    root = etree.fromstring(content, etree.XMLParser(resolve_entities=False, no_network=True))
    if root.tag != _ROOT:
        raise NoCertificate("it is no digital calibration certificate (DCC)")
    administrative = "dcc:administrativeData"
    covariance, coefficients = _coefficients(root)
    return Shown(
        number=_text(root, f"{_CORE}/dcc:uniqueIdentifier"),
        laboratory=_text(
            root, f"{administrative}/dcc:calibrationLaboratory/dcc:contact/dcc:name/dcc:content"
        ),
        customer=_text(root, f"{administrative}/dcc:customer/dcc:name/dcc:content"),
        items=tuple(_item(one) for one in _all(root, f"{administrative}/dcc:items/dcc:item")),
        calibrated=(
            _text(root, f"{_CORE}/dcc:beginPerformanceDate"),
            _text(root, f"{_CORE}/dcc:endPerformanceDate"),
        ),
        issued=_text(root, f"{_CORE}/dcc:issueDate"),
        authorised_by=_signer(root),
        conformity=_text(root, ".//dcc:metaData[@refType='bench_conformity']/dcc:conformity"),
        simulated=_states(root, "simulated"),
        says_signed=True if _states(root, "signed") else False if _states(root, "unsigned") else None,
        release=_text(root, f"{administrative}/dcc:dccSoftware/dcc:software/dcc:release"),
        coefficients=coefficients,
        covariance=covariance,
        files=dict(_file(one) for one in _all(root, ".//dcc:byteData")),
    )


def _states(root: Any, ref: str) -> bool:
    """Whether a document has a statement of ours of this name."""
    return bool(_all(root, f"dcc:administrativeData/dcc:statements/dcc:statement[@refType='bench_{ref}']"))


def _all(node: Any, path: str) -> list[Any]:
    return list(node.findall(path, _NAMES))


def _text(node: Any, path: str) -> str:
    found = node.find(path, _NAMES)
    return "" if found is None else " ".join("".join(found.itertext()).split())


def _item(item: Any) -> str:
    known = [_text(one, "dcc:value") for one in _all(item, "dcc:identifications/dcc:identification")]
    return ", ".join(filter(None, (_text(item, "dcc:name/dcc:content"), *known)))


def _signer(root: Any) -> str:
    for one in _all(root, "dcc:administrativeData/dcc:respPersons/dcc:respPerson"):
        if _text(one, "dcc:mainSigner") == "true":
            return _text(one, "dcc:person/dcc:name/dcc:content")
    return ""


def _file(node: Any) -> tuple[str, bytes]:
    name = _text(node, "dcc:fileName")
    try:
        return name, base64.b64decode(_text(node, "dcc:dataBase64"), validate=True)
    except binascii.Error as error:
        raise NotIntact(f"the file {name} in the digital certificate cannot be read") from error


def _coefficients(root: Any) -> tuple[tuple[tuple[float, ...], ...], tuple[Coefficient, ...]]:
    """Return covariance and coefficients of the last result that has them: of the unit as it is now."""
    results = _all(root, _COEFFICIENTS)
    found = None if not results else results[-1].find(_LIST, _NAMES)
    if found is None:
        return (), ()
    expanded = "si:measurementUncertaintyUnivariateXMLList/si:expandedMUXMLList"
    labels, units = _words(found, "si:labelXMLList"), _words(found, "si:unitXMLList")
    values = _numbers(found, "si:valueXMLList")
    U, k = (
        _numbers(found, f"{expanded}/si:{name}")
        for name in ("valueExpandedMUXMLList", "coverageFactorXMLList")
    )
    columns = _all(found, ".//si:covarianceMatrixXMLList/si:columnXMLList/si:covarianceXMLList")
    covariance = tuple(zip(*(_numbers(one, "si:valueXMLList") for one in columns), strict=True))
    if not len(labels) == len(units) == len(values) == len(U) == len(k) == len(covariance):
        raise NotIntact("the coefficients of the digital certificate are not one list")
    rows = zip(labels, values, U, k, units, strict=True)
    return covariance, tuple(Coefficient(*row) for row in rows)


def _words(node: Any, path: str) -> list[str]:
    return _text(node, path).split()


def _numbers(node: Any, path: str) -> list[float]:
    try:
        numbers = [float(word) for word in _words(node, path)]
    except ValueError as error:
        raise NotIntact(f"a number of the digital certificate cannot be read ({error})") from error
    if not all(map(math.isfinite, numbers)):
        raise NotIntact("a number of the digital certificate is none")
    return numbers
