"""Checks of certificates: one is issued from a record, verified, changed and revoked."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from bench.base.yaml_files import load_document
from bench.config.shipped import CERTIFICATE, shipped_folder
from bench.services.chain import LINES
from bench.services.errors import Refused
from bench.services.requests.documents import RevokeCertificate
from bench.validation.records import changed_copy, standard_run
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter
from drivers.clock import utc_now

check = partial(enter, family="certificates", place="bench/certificate")

UNITS = {"units": [{"received": "2026-11-16", "condition": "undamaged", "state": "as found"}]}
"""An order of any unit."""


def write_files(folder: Path, laboratory: Any = None, order: Any = None) -> tuple[Path, Path]:
    """Write the shipped laboratory and order files with sections replaced into a folder; return both paths."""
    written = []
    for name, sections in (("laboratory", laboratory), ("order", order)):
        data = yaml.safe_load((shipped_folder(CERTIFICATE) / f"{name}.yaml").read_text(encoding="utf-8"))
        data = {**data, **(sections or {})}
        for key in [key for key, value in data.items() if value is None]:
            del data[key]
        written.append(folder / f"{name}.yaml")
        written[-1].write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    return written[0], written[1]


@check("certificate", "7.8.1", "")
def life(context: Context) -> Iterator[Finding]:
    """Issue the certificate of a dry run, verify, change and revoke it; try to issue one for a changed record."""
    try:
        from bench.certificate import life as certificates
        from bench.certificate.verify import verify_certificate
    except ImportError as missing:
        yield Finding(
            True, f"this installation issues none ({missing.name} is not installed)", expected="none"
        )
        return
    run, folder = standard_run(context), context.scratch / "laboratory"
    folder.mkdir()
    laboratory, order = write_files(folder, order=UNITS)
    desk = certificates.Desk(
        run.folder.parent, load_document(laboratory), load_document(order), "A. Example", utc_now
    )
    issued = next(iter(certificates.issue_all([run.name], desk)))
    yield Finding(
        issued.why is None, issued.why or f"issued as {issued.number}", of="issued", expected="a number"
    )
    if issued.why is not None:
        return

    def judged(file: Path) -> Any:
        return verify_certificate(file, None, run.folder.parent, folder / "register")

    for suffix in (".xml", ".pdf"):
        file = folder / "register" / f"{issued.number}{suffix}"
        found = judged(file)
        yield Finding(found.accepted, found.headline, of=f"unchanged {suffix}", expected="accepted")
        content = file.read_bytes()
        at = len(content) // 2
        file.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        try:
            found = judged(file)
            yield Finding(
                not found.accepted, found.headline, of=f"one bit changed in {suffix}", expected="refused"
            )
        except Refused as refusal:
            yield Finding(True, str(refusal), of=f"one bit changed in {suffix}", expected="refused")
        file.write_bytes(content)
    number = str(issued.number)
    certificates.revoke(
        RevokeCertificate(number, reason="trial", laboratory=laboratory, authorised_by="A. Example")
    )
    found = judged(folder / "register" / f"{issued.number}.pdf")
    yield Finding(not found.accepted, found.headline, of="revoked", expected="refused")
    lines = folder / "register" / LINES
    content = lines.read_bytes()
    lines.write_bytes(content.replace(b"A. Example", b"B. Example", 1))
    try:
        judged(folder / "register" / f"{issued.number}.pdf")
        yield Finding(False, "taken as whole", of="a changed line of the register", expected="refused")
    except Refused as refusal:
        yield Finding(True, str(refusal), of="a changed line of the register", expected="refused")
    lines.write_bytes(content)
    changed = next(iter(certificates.issue_all([changed_copy(run).name], desk)))
    yield Finding(
        changed.why is not None, changed.why or "issued", of="of a changed record", expected="refused"
    )
