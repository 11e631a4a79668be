"""Is the XML of certificates valid by the institute's schemas, and read by other people's programs as written?

    python -m benchmarks.certificates schema --schema DIR
    python -m benchmarks.certificates readers --python VENV/bin/python --schema DIR

DIR has dcc.xsd (3.3.0) and SI_Format.xsd (2.2.1), anywhere below it; they are the user's, and not part of this
program. What they import of others (QUDT quantity kinds, the core of XML signatures) may be there, else stand-ins
take its place. `schema` checks certificates in one and two languages, amended and replaced, after an adjustment,
with and without a verification, signed and not, by the schemas and by our own rules; then changed documents, which
the schemas must refuse, so that they are seen to look.

`readers` asks pydcc and dcc-json-toolkit, which VENV has. The second looks for schemas in its cache, where they are
put from DIR, so that nothing is fetched; of the first what fetches schemas is left out. Both read the XML of a
simulated certificate; values and covariance of the coefficients (in both units), of N and of Δg that they return
must equal those of the result within 1e-12 of their size. Exit status 1 where one is not as it should be.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from bench.base.arrays import Floats
from bench.certificate.content import Before, Certificate, Issue
from bench.certificate.dcc.document import document_of
from bench.certificate.dcc.nodes import Schemas, broken_rules, parser, read_schemas
from bench.certificate.gather import certificate_of
from bench.certificate.laboratory import Adjusted, load_laboratory, load_order, texts_of
from bench.certificate.signatory import new_certificate_key, signatory_of
from bench.certificate.signatures import sign_xml
from bench.config.shipped import CERTIFICATE, shipped_folder
from benchmarks.campaign import arguments, done
from drivers.clock import utc_now


def certified(folder: Path, name: str = "source") -> Certificate:
    """Return the certificate of a dry run of the procedure `quick`, or of an import of its readings."""
    runs, readings = folder / "runs", folder / "readings.csv"
    if not runs.is_dir():
        done("run", "quick", "--dry-run", "--seed", "1", "--name", "source", "--runs", runs)
        done("export", "source", "--csv", readings, "--runs", runs)
        done("import", readings, "--name", "unit-0000", "--runs", runs)
    laboratory = load_laboratory(shipped_folder(CERTIFICATE) / "laboratory.yaml")
    text = (shipped_folder(CERTIFICATE) / "order.yaml").read_text(encoding="utf-8")
    order = folder / "order.yaml"
    order.write_text(text.replace("2026-11-16", "2026-01-01"), encoding="utf-8")
    now = utc_now().isoformat(timespec="seconds")
    issue = Issue("SIM-2026-0002", now, laboratory.authorised[0], signed_by="Laboratory")
    return certificate_of(name, runs, laboratory, load_order(order), issue)


# --- schema -----------------------------------------------------------------------------------------

CHANGES = (
    ("<dcc:typeOfChange>amended", "<dcc:typeOfChange>changed"),
    ("<si:coverageFactorXMLList>2.0 ", "<si:coverageFactorXMLList>0.5 "),
    ("<dcc:issueDate>", "<dcc:issueDate>the "),
    ("dcc:customer>", "dcc:client>"),
    ("<dcc:conformityXMLList>", "<dcc:conformityXMLList>good "),
)
"""Text of the amended certificate that no schema takes when it is changed."""


def schema(asked: argparse.Namespace, folder: Path) -> int:
    """Print which certificates are valid; return how many are not as they should be."""
    schemas = read_schemas(asked.schema)
    print(f"schemas in {asked.schema}; stand-ins for: {', '.join(schemas.stood_in) or 'nothing'}")
    key, now, wrong = folder / "keys" / "laboratory.pem", utc_now(), 0
    new_certificate_key(key, "Laboratory", None, now)
    signatory = signatory_of(str(key), None, lambda: b"", now)
    for run in ("unit-0000", "source"):
        for kind, certificate in variants(certified(folder, run)):
            document = document_of(certificate)
            for state, text in (("", document), (", signed", sign_xml(document, signatory, utc_now()))):
                found = [*schemas.mistakes(text), *broken_rules(text)]
                wrong += bool(found)
                print(f"{run}, {kind}{state}: {found[0] if found else 'valid'}")
            if kind == "amended":
                wrong += accepted(document.decode(), schemas)
    return wrong


def variants(plain: Certificate) -> Iterator[tuple[str, Certificate]]:
    """Yield certificates of all kinds with what each is."""
    yield "plain", plain
    yield "two languages", replace(plain, texts=(texts_of("en"), texts_of("de")))
    for kind in ("amended", "replaced"):
        before = Before(kind, "SIM-2026-0001", "2026-01-02", "the customer's name", "0" * 64)
        yield kind, replace(plain, issue=plain.issue and replace(plain.issue, before=before))
    if plain.unit is not None:
        unit = plain.unit.model_copy(update={"state": "as left", "adjusted": Adjusted(what="trimmed")})
        yield "adjusted", replace(plain, unit=unit, as_found=replace(plain.found))
    yield "no verification", replace(plain, found=replace(plain.found, verdict=None))


def accepted(document: str, schemas: Schemas) -> int:
    """Return how many changed documents the schemas accept."""
    changed = [document.replace(old, new) for old, new in CHANGES if old in document]
    count = sum(is_xml(text) and not schemas.mistakes(text.encode()) for text in changed)
    print(f"  changed: {len(changed) - count} of {len(changed)} refused")
    return count


def is_xml(text: str) -> bool:
    """Whether a text is XML at all."""
    try:
        etree.fromstring(text.encode(), parser())
    except etree.XMLSyntaxError:
        return False
    return True


# --- readers ----------------------------------------------------------------------------------------

WITHIN = 1e-12
PYDCC = """
import json, sys, types
try:
    import certvalidator
except Exception as error:
    # the library of its signatures may not load beside the OpenSSL of the system; no signature is read here
    print(f"pydcc: certvalidator is stood in for: {error}", file=sys.stderr)
    stand_in = types.ModuleType("certvalidator")
    stand_in.CertificateValidator = stand_in.ValidationContext = stand_in.errors = None
    sys.modules["certvalidator"] = stand_in
import dcc.dcc
dcc.dcc.DCCXMLValidator = lambda: None  # it fetches schemas as it is made
found = dcc.dcc.DCC(sys.argv[1], signature_verification=False).get_calibration_results("name")
json.dump([quantity for _, quantity in found], sys.stdout)
"""
TOOLKIT = """
import json, sys
from dcc_json_toolkit import DccSchema
schema = DccSchema("3.3.0")
problems = schema.validate_dcc(open(sys.argv[1], encoding="utf-8").read())
print(f"dcc-json-toolkit: {len(problems)} problems with the document {problems[:2]}", file=sys.stderr)
json.dump(schema.to_dict(open(sys.argv[1], encoding="utf-8").read()), sys.stdout, default=str)
"""


def readers(asked: argparse.Namespace, folder: Path) -> int:
    """Print how far what the programs read is from what was written; return how much of it is not within."""
    certificate, document, wrong = certified(folder), folder / "certificate.xml", 0
    document.write_bytes(document_of(certificate))
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": ""}
    if asked.schema is not None:
        fill_cache(asked.schema, folder / "cache" / "DccJsonToolkit" / "3.3.0")
    for name, program in (("pydcc", PYDCC), ("dcc-json-toolkit", TOOLKIT)):
        words = [asked.python, "-c", program, str(document)]
        read = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
        print("".join(f"  {line}\n" for line in read.stderr.splitlines()[-3:]), end="")
        if read.returncode:
            print(f"{name}: does not read it")
            wrong += 1
            continue
        wrong += judged(name, json.loads(read.stdout), certificate)
    return wrong


def fill_cache(schema: Path, folder: Path) -> None:
    """Put the schemas where dcc-json-toolkit looks for those that it fetched before."""
    folder.mkdir(parents=True)
    for path in schema.rglob("*.xsd"):
        text = path.read_text(encoding="utf-8")
        text = re.sub(r'schemaLocation="[^"]*?([^/"]+\.xsd)"', rf'schemaLocation="file://{folder}/\1"', text)
        (folder / path.name).write_text(text, encoding="utf-8")


def judged(name: str, told: Any, certificate: Certificate) -> int:
    """Print how far what a program read is from what was written; return how much of it is not within."""
    found = [pair for pair in lists_in(told) if pair[1].shape == (len(pair[0]),) * 2]
    wrong = 0
    for what, (values, covariance) in expected(certificate).items():
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        parts = [
            (got / values - 1.0, (matrix - covariance) / np.where(scale > 0, scale, 1.0))
            for got, matrix in found
            if got.shape == values.shape
        ]
        least = min((max(float(np.max(np.abs(part))) for part in pair) for pair in parts), default=np.inf)
        wrong += not least <= WITHIN
        print(f"{name}: {what}: {f'off by {least:.1e}' if parts else 'not found'}")
    return wrong


def expected(certificate: Certificate) -> dict[str, tuple[Floats, Floats]]:
    """Return what is to be found, values and covariance, by what it is."""
    found = certificate.found
    own, inverse = found.result.calibration, found.result.derived.inverse
    scale = np.concatenate([np.full(9, 1.0 / own.g_m_s2), np.ones(3)])
    of_g = own.block.vector * scale * own.gravity_u * (np.arange(12) < 9)
    per_ms2 = own.covariance * np.outer(scale, scale) + np.outer(of_g, of_g)
    expected = {
        "coefficients": (own.block.vector, own.covariance),
        "coefficients per m/s²": (own.block.vector * scale, per_ms2),
        "N": (inverse.values, inverse.covariance),
    }
    if found.verification is not None:
        points = np.array([point.delta_g for point in found.verification.points])
        expected["delta g"] = (points, found.verification.covariance)
    return expected


def lists_in(told: Any) -> Iterator[tuple[Floats, Floats]]:
    """Yield values and covariance of each list with a covariance in what a program returned."""
    if isinstance(told, Mapping):
        named = {str(name).rpartition(":")[2]: part for name, part in told.items()}
        if "valueXMLList" in named and "measurementUncertaintyMultivariateXMLList" in named:
            columns = [numbers(column) for column in columns_in(named)]
            yield numbers(named["valueXMLList"]), np.array(columns).T
        told = list(named.values())
    for part in told if isinstance(told, list) else ():
        yield from lists_in(part)


def columns_in(told: Any) -> Iterator[Any]:
    """Yield the values of each column of a covariance."""
    for name, part in told.items() if isinstance(told, Mapping) else ():
        if str(name).endswith("covarianceXMLList"):
            for one in part if isinstance(part, list) else [part]:
                yield next(value for key, value in one.items() if str(key).endswith("valueXMLList"))
        else:
            yield from columns_in(part)
    for part in told if isinstance(told, list) else ():
        yield from columns_in(part)


def numbers(told: Any) -> Floats:
    """Return numbers that a program returns as text or as a list of whatever."""
    if isinstance(told, Mapping):
        told = told.get("#text", told.get("$"))
    return np.array([float(word) for word in (told.split() if isinstance(told, str) else told)])


def main() -> int:
    asked = arguments(
        __doc__, part={"positional": True, "choices": ("schema", "readers")},
        python={"metavar": "FILE", "help": "that of an environment with both readers"},
        schema={"type": Path, "metavar": "DIR", "help": "the institute's schemas, all that they import"},
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        return 1 if {"schema": schema, "readers": readers}[asked.part](asked, Path(folder)) else 0


if __name__ == "__main__":
    sys.exit(main())
