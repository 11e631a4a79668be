"""Certificates from the command line: issued once, amended, revoked, handed out and made again."""

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from lxml import etree

from bench.certificate.dcc.nodes import NAMESPACES
from bench.certificate.signatures import check_xml
from tests.support.certificates import ORDER, RECORDED, copy_run, write_files
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to

BY = ("--authorised-by", "A. Example")


@pytest.fixture
def desk(empty_folder):
    """Laboratory and order as options, and a run `finished`."""
    Path("runs").mkdir()
    copy_run(Path("runs"))
    laboratory, order = write_files(Path(), order=ORDER)
    return ("--laboratory", laboratory, "--order", order, *BY)


def number_in(file):
    return etree.parse(file).findtext(".//dcc:uniqueIdentifier", namespaces=NAMESPACES)


@pytest.mark.slow
def test_a_certificate_is_issued_once_and_handed_out_again(bench, desk):
    status, out, err = bench("certificate", "finished", *desk, "--json", "first.json")
    assert status == 0, err
    assert "issued as SIM-2026-0001" in out
    assert "not signed" in err
    issued = {path.name: path.read_bytes() for path in Path("register").glob("SIM*")}
    assert set(issued) == {"SIM-2026-0001.xml", "SIM-2026-0001.pdf"}
    assert number_in("register/SIM-2026-0001.xml") == "SIM-2026-0001"
    first = json.loads(Path("first.json").read_text())
    keeps_to("certificate", first)
    assert first["certificates"][0]["issued_before"] is False

    status, out, err = bench("certificate", "issue", "finished", *desk)
    assert (status, "issued before as SIM-2026-0001" in out, err) == (0, True, "")
    shutil.rmtree("runs/finished/what-if", ignore_errors=True)
    status, out, _ = bench(
        "certificate", "register", "SIM-2026-0001", *desk[:2], "--out", "again", "--json", "r.json"
    )
    assert status == 0
    assert {path.name: path.read_bytes() for path in Path("again").iterdir()} == issued
    keeps_to("certificate-register", json.loads(Path("r.json").read_text()))


@pytest.mark.slow
def test_the_unsigned_certificate_is_made_again_byte_for_byte(bench, desk, tmp_path):
    key = tmp_path / "keys" / "laboratory.pem"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bench.cli.printing.passphrase", lambda *_: b"", raising=True)
        from bench.certificate.signatory import new_certificate_key
        from drivers.clock import utc_now

        new_certificate_key(key, "Laboratory", None, utc_now())
    status, _, err = bench("certificate", "finished", *desk, "--key", key)
    assert (status, err) == (0, "")
    check_xml(Path("register/SIM-2026-0001.xml").read_bytes())
    Path("order.yaml").unlink()
    bench("seal", "finished")
    out = printed(bench("certificate", "register", *desk[:2], "--again", "--json", "-"))
    assert json.loads(out)["certificates"][0]["made_again"] is True
    with Path("runs/finished/events.jsonl").open("rb+") as events:
        events.truncate(events.seek(0, 2) - 40)
    status, _, err = bench("certificate", "register", *desk[:2], "--again")
    assert status == 1
    assert "SIM-2026-0001: " in err


@pytest.mark.slow
def test_a_certificate_is_made_again_by_the_rules_of_its_day(bench, desk, monkeypatch):
    """A text that is refused now was printed then; the laboratory file of today is without it."""
    own = {"en": {"expired": "out of date"}}
    unit = {**ORDER["units"][0], "condition": " "}
    with monkeypatch.context() as then:
        then.setattr("bench.certificate.laboratory._FIXED", frozenset())
        then.setattr("bench.certificate.laboratory._stripped", lambda data, **_: data)
        write_files(Path(), {"texts": own}, {**ORDER, "units": [unit]})
        assert bench("certificate", "finished", *desk)[0] == 0
    refused(bench("certificate", "register", *desk[:2], "--again"), "no laboratory may replace this text")
    write_files(Path(), order=ORDER)
    assert bench("certificate", "register", *desk[:2], "--again")[0] == 0


@pytest.mark.slow
def test_a_certificate_of_texts_with_spaces_around_them_is_made_again(bench, desk):
    """A block of text in YAML (`|`) ends with a line break, which is not printed."""
    unit = {**ORDER["units"][0], "condition": "undamaged\n"}
    write_files(Path(), {"environment": " from 30 % to 60 % "}, {**ORDER, "units": [unit]})
    assert bench("certificate", "finished", *desk)[0] == 0
    assert bench("certificate", "register", *desk[:2], "--again")[0] == 0


@pytest.mark.slow
def test_an_amended_certificate_names_the_one_before_which_holds_no_more(bench, desk):
    assert bench("certificate", "finished", *desk)[0] == 0
    first = Path("register/SIM-2026-0001.xml").read_bytes()
    verify = ("certificate", "verify", "register/SIM-2026-0001.xml", *desk[:2], "--json", "v.json")
    status, out, _ = bench(*verify)
    assert (status, "not signed, unchanged since it was issued" in out, "signer" in out) == (0, True, False)
    keeps_to("certificate-verify", json.loads(Path("v.json").read_text()))
    amend = ("certificate", "amend", "SIM-2026-0001", "finished", "--reason", "a name")
    Path("bench.yaml").write_bytes((RECORDED.parent / "finished" / "bench.yaml").read_bytes())
    assert bench("run", "quick", "--dry-run", "--bench", "bench.yaml", "--name", "other")[0] in (0, 1)
    other = ("certificate", "amend", "SIM-2026-0001", "other", "--reason", "other results")
    refused(bench(*other, *desk), "for another run than other (finished); name that run, or add --replace")
    printed(bench(*amend, *desk), "SIM-2026-0002")
    printed(bench(*verify), "AMENDED (SIM-2026-0002)", status=1)
    keeps_to("certificate-verify", json.loads(Path("v.json").read_text()))
    core = etree.parse("register/SIM-2026-0002.xml").find(".//dcc:coreData", NAMESPACES)
    assert core.findtext("dcc:previousReport/dcc:referralID", namespaces=NAMESPACES) == "SIM-2026-0001"
    import hashlib

    said = core.findtext("dcc:previousReport/dcc:value", namespaces=NAMESPACES)
    assert said == hashlib.sha256(first).hexdigest()
    refused(bench(*amend, *desk), "it was amended by SIM-2026-0002")
    revoke = ("certificate", "revoke", "SIM-2026-0002", "--reason", "wrong unit", *desk[:2], *BY)
    refused(bench(*revoke[:4], " ", *revoke[5:]), "--reason: no text; state the reason")
    refused(bench(*amend[:5], "", *desk), "--reason: no text; state the reason")
    assert bench(*revoke)[0] == 0
    refused(bench(*revoke), "it was revoked: wrong unit")
    _, out, _ = bench("certificate", "register", *desk[:2])
    assert out.count("not signed") == 2
    assert "amended (SIM-2026-0002)" in out
    assert "revoked (wrong unit)" in out
    assert bench("certificate", "finished", *desk)[1].startswith("finished: issued as SIM-2026-0003")
    # it names the revoked one, which stays revoked
    again = etree.parse("register/SIM-2026-0003.xml").find(".//dcc:coreData", NAMESPACES)
    assert again.findtext("dcc:previousReport/dcc:referralID", namespaces=NAMESPACES) == "SIM-2026-0002"
    assert "revoked (wrong unit)" in bench("certificate", "register", *desk[:2])[1]
    third = ("certificate", "amend", "SIM-2026-0003", *other[3:], "--replace")
    elsewhere = {"street": "Main St 1", "post_code": "10115", "city": "Berlin", "country": "DE"}
    write_files(Path(), {"name": "Another Laboratory", "address": elsewhere, "accreditation": None}, ORDER)
    refused(bench(*third, *desk), "Inertial Calibration Laboratory issued it, not Another Laboratory")
    write_files(Path(), {"name": "Inertial Laboratory"}, ORDER)  # a corrected name, at the old address
    printed(bench(*third, *desk), "SIM-2026-0004")
    write_files(Path(), order=ORDER)
    assert "replaced (SIM-2026-0004)" in bench("certificate", "register", *desk[:2])[1]
    refused(bench("certificate", "finished", *desk), "SIM-2026-0003 was replaced by SIM-2026-0004; 'bench")


@pytest.mark.slow
def test_one_bad_run_does_not_stop_the_others(bench, desk):
    shutil.copytree(RECORDED.parent / "interrupted", "runs/interrupted")
    copy_run(Path("runs"), "changed")
    lines = Path("runs/changed/events.jsonl")
    lines.write_bytes(lines.read_bytes().replace(b"step_done", b"step_dnoe", 1))
    status, out, err = bench(
        "certificate", "nosuch", "interrupted", "changed", "finished", *desk, "--json", "all.json"
    )
    assert status == 1
    assert "finished: issued as SIM-2026-0001" in out
    for name, why in (
        ("nosuch", "no run of that name"),
        ("interrupted", "has ended"),
        ("changed", "cannot be trusted"),
    ):
        assert any(line.startswith(f"bench: {name}: ") and why in line for line in err.splitlines()), err
    told = json.loads(Path("all.json").read_text())["certificates"]
    keeps_to("certificate", {"certificates": told})
    assert [one["number"] for one in told] == [None, None, None, "SIM-2026-0001"]


@pytest.mark.slow
def test_a_draft_needs_nobody_and_takes_no_number(bench, desk):
    assert bench("certificate", "finished", "--draft")[0] == 0
    assert Path("runs/finished/certificate-draft.pdf").read_bytes().startswith(b"%PDF")
    assert bench("certificate", "issue", "finished", "--draft", "--out", "drafts")[0] == 0
    assert Path("drafts/finished-certificate-draft.pdf").is_file()
    assert not Path("register").exists()


def test_what_a_certificate_needs_is_told(bench, desk):
    refused(
        bench("certificate", "finished", "--laboratory", "laboratory.yaml"),
        "needs --order FILE, --authorised-by NAME",
    )
    refused(
        bench("certificate", "finished", *desk[:4], "--authorised-by", "Somebody"),
        "choose one of them",
    )
    refused(
        bench("certificate", "revoke", "7", "--reason", "x", *desk[:2], *BY), "no certificate of that number"
    )
    Path("order.yaml").write_text("customer: me\nunits: []\n")
    refused(bench("certificate", "finished", *desk), "order.yaml:1: customer", "order.yaml:2: units", lines=3)


def test_what_is_missing_is_listed_and_nothing_is_issued(bench, desk):
    write_files(Path(), order={"units": [{**ORDER["units"][0], "received": "2026-12-01"}]})
    refused(bench("certificate", "finished", *desk), "not issued; missing: a day of receipt")
    assert list(Path("register").glob("SIM*")) == []


@pytest.mark.slow
def test_a_run_on_real_instruments_is_numbered_apart_and_says_what_it_does_without(bench, desk):
    readings = RECORDED.parent / "readings.csv"
    assert bench("import", readings, "--name", "mine", "--bench", RECORDED / "bench.yaml")[0] == 0
    unit = {**ORDER["units"][0], "received": "2026-01-02", "calibrated": "2026-01-03"}
    write_files(Path(), order={"units": [unit]})
    refused(bench("certificate", "mine", *desk), "the traceability of voltmeter.x")
    write_files(Path(), order={"units": [unit], "without_certificates": "a comparison in the house"})
    assert bench("certificate", "mine", "finished", *desk)[0] == 0
    (file,) = Path("register").glob("2*.xml")
    assert number_in(file) == file.stem
    assert file.stem.endswith("-0001")
    assert len(list(Path("register").glob("SIM-*-0001.xml"))) == 1
    root = etree.parse(file)
    core = root.find(".//dcc:coreData", NAMESPACES)
    assert core.findtext("dcc:beginPerformanceDate", namespaces=NAMESPACES) == "2026-01-03"
    said = root.find(".//dcc:statement[@refType='bench_traceability']", NAMESPACES)
    assert said.findtext("dcc:traceable", namespaces=NAMESPACES) == "false"
    assert "a comparison in the house" in "".join(said.itertext())
    assert root.find(".//dcc:statement[@refType='bench_simulated']", NAMESPACES) is None


@pytest.mark.slow
def test_coefficients_are_read_out_of_the_pdf_as_out_of_the_xml(bench, desk):
    assert bench("certificate", "finished", *desk)[0] == 0
    for form in ("xml", "pdf"):
        (file,) = Path("register").glob(f"SIM-*.{form}")
        assert bench("certificate", "read", file, "--out", f"{form}.json")[0] == 0
    assert Path("pdf.json").read_bytes() == Path("xml.json").read_bytes()
    status, out, _ = bench("verify", "finished", "--coefficients", "pdf.json", "--json", "-")
    assert (status, json.loads(out)["passed"]) == (0, True)
    assert bench("compare", "pdf.json", "finished")[0] == 0
    Path("empty.pdf").write_bytes(b"%PDF-1.7 nothing")
    refused(bench("certificate", "read", "empty.pdf", "--out", "c.json"), "a PDF that cannot be read")


@pytest.mark.slow
def test_no_certificate_is_dated_before_the_last_one(bench, desk, monkeypatch):
    """The first one has the true date, which is later than the recorded run's."""
    assert bench("certificate", "finished", *desk)[0] == 0
    monkeypatch.setattr("bench.certificate.life.utc_now", lambda: datetime(2026, 11, 23, tzinfo=UTC))
    amend = ("certificate", "amend", "SIM-2026-0001", "finished", "--reason", "a name")
    refused(bench(*amend, *desk), "this computer's clock shows 2026-11-23, but SIM-2026-0001 was issued on")


@pytest.mark.slow
def test_a_certificate_of_a_clock_that_was_fast_stops_no_other_once_it_is_revoked(bench, desk, monkeypatch):
    """Nobody could issue a certificate until the wrong day had come."""
    with monkeypatch.context() as fast:
        fast.setattr("bench.certificate.life.utc_now", lambda: datetime(2099, 1, 1, tzinfo=UTC))
        assert bench("certificate", "finished", *desk)[0] == 0
    amend = ("certificate", "amend", "SIM-2099-0001", "finished", "--reason", "day")
    refused(bench(*amend, *desk), "if that day is wrong, revoke SIM-2099-0001")
    revoke = ("certificate", "revoke", "SIM-2099-0001", "--reason", "wrong day")
    assert bench(*revoke, *desk[:2], *BY)[0] == 0
    assert bench("certificate", "finished", *desk)[0] == 0
    (again,) = set(Path("register").glob("SIM-2*.xml")) - {Path("register/SIM-2099-0001.xml")}
    assert "SIM-2099-0001" in again.read_text()
    assert bench("certificate", "register", *desk[:2], "--again")[0] == 0
