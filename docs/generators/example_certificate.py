"""The certificate that the documentation shows: of a dry run, issued and signed when the site is built."""

from __future__ import annotations

import contextlib
import io
import tempfile
from pathlib import Path
from typing import Final

_PAGE: Final = """\
# An example of a certificate

The build of this site makes this certificate from a dry run of the paper's procedure and the laboratory and order
files that `bench init` writes, in two languages, and signs it with a key that it then deletes. So every page says that
the run is simulated, and the number is of the series `SIM-`. See [Certificates](../certificates.md).

```{include} _example-certificate.md
```

## What is in the XML

| where | what |
| --- | --- |
| `administrativeData` | number, dates, laboratory, customer, unit, who authorises, the record with its seal |
| `usedMethods` | procedure with the hash of its plan, estimator, model formula |
| `measuringEquipments` | each instrument, its answer, its certificate (hash `none`) and validity |
| `statements` | `bench_signed` or `bench_unsigned`; sampling, external providers, the customer's data |
| `influenceConditions` | temperature of the block, chamber, supply, local gravity |
| `bench_coefficients` | the twelve coefficients with U, k and **the full 12 × 12 covariance**; K in `\\volt`, per local g |
| `bench_coefficients_si` | the same per m/s²: K in `\\volt\\metre\\tothe{-1}\\second\\tothe{2}`, with the uncertainty of gravity |
| `bench_inverse`, `bench_misalignments` | N = K⁻¹ with U0; the six angles; each with its covariance |
| `bench_delta_g` | Δg at the verification points with U, covariance, statements, limit and risk |
| `bench_readings`, `bench_file` | the readings; the result as `bench calibrate --json` writes it, with the verdict |
"""  # noqa: E501 - rows of a table
_FILES: Final = "example"
_PART: Final = """\
`bench certificate verify` says of this certificate: *{headline}*. Its files are the [PDF]({files}/certificate.pdf),
with attachments, and the [XML]({files}/certificate.xml).

{pictures}
"""


def page() -> str:
    """Return the page; what it shows is written by `write_example`."""
    return _PAGE


def write_example(reference: Path) -> None:
    """Write both forms of a certificate, pictures of its pages and the part of the page that shows them."""
    from bench.certificate.verify import verify_certificate

    folder = reference / _FILES
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("page-*.png"):
        stale.unlink()
    with tempfile.TemporaryDirectory() as temporary:
        xml, pdf, pages = _made(Path(temporary))
    (folder / "certificate.xml").write_bytes(xml)
    (folder / "certificate.pdf").write_bytes(pdf)
    for number, picture in enumerate(pages, 1):
        (folder / f"page-{number}.png").write_bytes(picture)
    names = [f"![Page {n} of the certificate]({_FILES}/page-{n}.png)" for n in range(1, len(pages) + 1)]
    for scheme in ("light", "dark"):  # paper is white in both
        (reference / "pictures").mkdir(exist_ok=True)
        (reference / "pictures" / f"certificate-{scheme}.png").write_bytes(pages[0])
    headline = verify_certificate(folder / "certificate.pdf", None, folder / "none").verdict
    part = _PART.format(headline=headline, files=_FILES, pictures="\n\n".join(names))
    (reference / "_example-certificate.md").write_text(part, encoding="utf-8")


def _made(folder: Path) -> tuple[bytes, bytes, list[bytes]]:
    """Return the signed forms of a certificate, and its pages as pictures (PNG)."""
    from bench.certificate.content import Issue
    from bench.certificate.dcc.document import document_of
    from bench.certificate.gather import certificate_of, issued_at
    from bench.certificate.laboratory import load_laboratory, load_order
    from bench.certificate.page import body_of, pictures_of
    from bench.certificate.signatory import new_certificate_key, signatory_of
    from bench.certificate.signatures import sign_pdf, sign_xml
    from bench.cli.app import main
    from bench.config.shipped import CERTIFICATE, shipped_folder
    from drivers.clock import utc_now

    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(["run", "paper", "--dry-run", "--name", "unit-17", "--runs", str(folder / "runs")])
    now = utc_now()
    shipped = shipped_folder(CERTIFICATE)
    written = (shipped / "laboratory.yaml").read_text(encoding="utf-8")
    (folder / "laboratory.yaml").write_text(
        written.replace("language: en ", "language: [en, de] "), encoding="utf-8"
    )
    laboratory = load_laboratory(folder / "laboratory.yaml")
    issue = Issue("SIM-2026-0001", issued_at(now), laboratory.authorised[0], signed_by=laboratory.name)
    order = load_order(shipped / "order.yaml")
    certificate = certificate_of("unit-17", folder / "runs", laboratory, order, issue)
    key = folder / "keys" / "laboratory.pem"
    new_certificate_key(key, laboratory.name, None, now)
    signatory = signatory_of(str(key), None, lambda: b"", now)
    xml = sign_xml(document_of(certificate), signatory, now)
    pdf = sign_pdf(body_of(certificate, xml), signatory, now, certificate.number, certificate.place)
    return xml, pdf, pictures_of(certificate, xml)
