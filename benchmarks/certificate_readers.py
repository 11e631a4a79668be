"""Do other people's programs read a certificate as it was written? pydcc and dcc-json-toolkit are asked.

    python -m benchmarks.certificate_readers --python VENV/bin/python --schema DIR

VENV is an environment of its own with `pydcc` and `dcc-json-toolkit`. The second needs the institute's schemas,
which it fetches where it finds none in its cache: they are put there from DIR, so that nothing is fetched; of
the first what fetches schemas is left out. Both read the XML of a simulated certificate; values and covariance
of the coefficients (in both units), of N and of Δg that they return are compared with those of the result.
Promised: equal within 1e-12 of their size. Exit status 1 otherwise.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.arrays import Floats
from bench.certificate.content import Certificate, Issue
from bench.certificate.dcc.document import document_of
from bench.certificate.gather import certificate_of
from benchmarks.campaign import arguments
from benchmarks.certificate_desk import prepare
from drivers.clock import utc_now

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


def expected(certificate: Certificate) -> dict[str, tuple[Floats, Floats]]:
    """Return what is to be found, values and covariance, by what it is."""
    found = certificate.found
    own = found.result.calibration
    scale = np.concatenate([np.full(9, 1.0 / own.g_m_s2), np.ones(3)])
    of_g = own.block.vector * scale * own.gravity_u * (np.arange(12) < 9)
    expected = {
        "coefficients": (own.block.vector, own.covariance),
        "coefficients per m/s²": (
            own.block.vector * scale,
            own.covariance * np.outer(scale, scale) + np.outer(of_g, of_g),
        ),
        "N": (found.result.derived.inverse.values, found.result.derived.inverse.covariance),
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
        for part in named.values():
            yield from lists_in(part)
    elif isinstance(told, list):
        for part in told:
            yield from lists_in(part)


def columns_in(told: Any) -> Iterator[Any]:
    """Yield the values of each column of a covariance."""
    if isinstance(told, Mapping):
        for name, part in told.items():
            if str(name).endswith("covarianceXMLList"):
                for one in part if isinstance(part, list) else [part]:
                    yield next(value for key, value in one.items() if str(key).endswith("valueXMLList"))
            else:
                yield from columns_in(part)
    elif isinstance(told, list):
        for part in told:
            yield from columns_in(part)


def numbers(told: Any) -> Floats:
    """Return numbers that a program returns as text or as a list of whatever."""
    if isinstance(told, Mapping):
        told = told.get("#text", told.get("$"))
    return np.array([float(word) for word in (told.split() if isinstance(told, str) else told)])


def judged(name: str, told: Any, certificate: Certificate) -> int:
    """Print how far what a program read is from what was written; return how much of it is not within."""
    found = [pair for pair in lists_in(told) if pair[1].shape == (len(pair[0]),) * 2]
    wrong = 0
    for what, (values, covariance) in expected(certificate).items():
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        off = [
            max(
                float(np.max(np.abs(got / values - 1.0))),
                float(np.max(np.abs(matrix - covariance) / np.where(scale > 0, scale, 1.0))),
            )
            for got, matrix in found
            if got.shape == values.shape
        ]
        least = min(off, default=float("inf"))
        wrong += not least <= WITHIN
        print(f"{name}: {what}: {'not found' if not off else f'off by {least:.1e}'}")
    return wrong


def filled_cache(schema: Path, cache: Path) -> None:
    """Put the schemas where dcc-json-toolkit looks for those that it fetched before."""
    folder = cache / "DccJsonToolkit" / "3.3.0"
    folder.mkdir(parents=True)
    for path in schema.rglob("*.xsd"):
        text = path.read_text(encoding="utf-8")
        text = re.sub(r'schemaLocation="[^"]*?([^/"]+\.xsd)"', rf'schemaLocation="file://{folder}/\1"', text)
        (folder / path.name).write_text(text, encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    asked = arguments(
        __doc__,
        argv,
        python={"required": True, "metavar": "FILE", "help": "that of an environment with both readers"},
        schema={"type": Path, "metavar": "DIR", "help": "the institute's schemas, all that they import"},
    )
    wrong = 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        desk, _ = prepare(folder, 0)
        issue = Issue("SIM-2026-0001", utc_now().isoformat(timespec="seconds"), desk.laboratory.authorised[0])
        certificate = certificate_of("source", desk.runs, desk.laboratory, desk.order, issue)
        document = folder / "certificate.xml"
        document.write_bytes(document_of(certificate))
        environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": ""}
        if asked.schema is not None:
            filled_cache(asked.schema, folder / "cache")
        for name, program in (("pydcc", PYDCC), ("dcc-json-toolkit", TOOLKIT)):
            done = subprocess.run(  # noqa: S603 - the two programs above
                [asked.python, "-c", program, str(document)],
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            print("".join(f"  {line}\n" for line in done.stderr.splitlines()[-3:]), end="")
            if done.returncode:
                print(f"{name}: does not read it")
                wrong += 1
                continue
            wrong += judged(name, json.loads(done.stdout), certificate)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
