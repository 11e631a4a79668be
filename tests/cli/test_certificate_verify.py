"""`bench certificate verify` at the command line: issued and signed by it, looked at, spoilt."""

import json
from pathlib import Path

import pytest

from bench.certificate import proof
from tests.support.certificates import ORDER, copy_run, write_files
from tests.support.schemas import keeps_to


@pytest.mark.slow
def test_what_is_issued_and_signed_is_intact_until_it_is_changed(bench, monkeypatch):
    for name in ("residuals_by_angle", "verification_points"):
        monkeypatch.setattr(proof, name, lambda _: '<svg viewBox="0 0 2 1"><path d="M0 0L2 1"/></svg>')
    copy_run(Path("runs"))
    laboratory, order = write_files(Path(), None, ORDER)
    assert bench("key", "keys/lab.pem", "--certificate", "Laboratory of Tests")[0] == 0
    status, out, err = bench(
        "certificate", "finished", "--laboratory", laboratory, "--order", order,
        "--authorised-by", "A. Example", "--key", "keys/lab.pem", "--json", "issued.json",
    )  # fmt: skip
    assert status == 0, err
    files = json.loads(Path("issued.json").read_text())["certificates"][0]["files"]
    (pdf,) = (one for one in files if one.endswith(".pdf"))
    status, out, _ = bench("certificate", "verify", pdf, "--json", "verdict.json")
    assert status == 0
    assert "intact, signer unknown" in out
    assert "SIMULATED" in out
    assert "Kxx" in out
    assert "the same result to the last digit" in out
    assert "not proved: who signed" in out
    keeps_to("certificate-verify", json.loads(Path("verdict.json").read_text()))
    for file in files:
        assert (
            "signed by Laboratory of Tests"
            in bench("certificate", "verify", file, "--trust", "keys/lab.pem.crt")[1]
        )
    bench("key", "keys/other.pem", "--certificate", "Laboratory of Tests")
    status, out, _ = bench("certificate", "verify", pdf, "--trust", "keys/other.pem.crt")
    assert (status, "signer not trusted" in out) == (1, True)
    Path(pdf).write_bytes(Path(pdf).read_bytes() + b"\n")
    status, out, _ = bench("certificate", "verify", pdf, "--json", "verdict.json")
    assert status == 1
    assert "CHANGED" in out
    assert "Kxx" not in out
    keeps_to("certificate-verify", json.loads(Path("verdict.json").read_text()))
    assert bench("certificate", "verify", "none.pdf")[0] == 2
