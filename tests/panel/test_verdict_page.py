"""Looking back on a run: what its files tell, damaged ones too, and the pages that stand apart."""

import json
import re
import shutil

import pytest

from bench.base.numbers import rounded
from bench.certificate.laboratory import load_laboratory
from bench.certificate.register import ISSUED, Register
from bench.panel.access import STATE, Access, Role, Settings
from bench.panel.app import make_app
from bench.panel.own_files import NEXT
from bench.run.events import EVENTS
from bench.run.folder import BENCH
from bench.services.chain import Entry, opened
from tests.support.pages import ROOT
from tests.support.panel_client import HOME, OWN, Browser, TestClient

RECORDS = ROOT / "tests" / "data" / "records"


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    shutil.copytree(RECORDS / "finished", tmp_path / "runs" / "one")
    return tmp_path / "runs"


def words(reply):
    return " ".join(re.sub(r"<[^>]*>", " ", reply.text).split())


def test_the_verdict_stands_with_its_uncertainty_limit_and_risk(anna, judged):
    verify = json.loads((judged / "verify.json").read_text())
    worst = max(verify["points"], key=lambda p: abs(p["delta_g"]))
    page = anna.get("/runs/run/verdict")
    said = words(page)
    shown = re.search(r"worst \|Δg\| = ([\d.]+) ± ([\d.]+) µg", said)
    assert shown[1] == rounded(abs(worst["delta_g"]) * 1e6, worst["U"] * 1e6)
    assert float(shown[2]) == pytest.approx(worst["U"] * 1e6, rel=0.05)
    assert "limit 300 µg" in said
    assert "probability of a false acceptance: " in said
    hidden = json.loads((judged / "calibrate.json").read_text())["not_observable"]
    assert len(hidden) > 0
    assert page.text.count("<li>") == len(hidden)
    assert all(f">{name}<" in page.text for name in ("Kxx", "Kzy", "U0z"))
    assert "Simulated instruments" in said


def test_a_scale_factor_has_the_unit_that_the_report_prints(anna, judged):
    told = json.loads((judged / "calibrate.json").read_text())
    (judged / "calibrate.json").write_text(json.dumps({**told, "unit": "m/s^2"}))
    units = set(re.findall(r"<td>([^<]*/g)</td>", anna.get("/runs/run/verdict").text))
    assert units
    assert all(re.fullmatch(r"\(.*m/s²\)/g", unit) for unit in units)


def test_report_and_figures_stand_apart_and_nothing_of_them_acts(anna, judged, bench, monkeypatch):
    drawn = '<svg viewBox="0 0 1 1">\n<g id="a">\n<path d="M 0 0\nL 1 1"/>\n</g>\n</svg>\n'
    monkeypatch.setattr("bench.results.plots._written", lambda name, inches, draw: drawn)
    assert bench("report", judged)[0] in (0, None)
    report = anna.get("/runs/run/report")
    assert report.content == (judged / "report.html").read_bytes()
    assert "sandbox" in report.headers["content-security-policy"]
    assert "script-src" not in report.headers["content-security-policy"]
    labels = set()
    for name in ("residuals", "residuals-in-time", "verification"):
        figure = anna.get(f"/runs/run/figures/{name}")
        assert figure.headers["content-type"] == "image/svg+xml"
        assert figure.text.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
        assert figure.text.endswith('<path d="M 0 0\nL 1 1"/></g></svg>')
        labels.add(re.search(r'aria-label="([^"]*)"', figure.text)[1])
    assert len(labels) == 3
    assert anna.get("/runs/run/figures/other").status_code == 404


def test_a_failed_verdict_offers_the_diagnosis_and_then_the_measurement_that_would_tell(
    anna, runs, judged, monkeypatch
):
    verify = json.loads((judged / "verify.json").read_text())
    (judged / "verify.json").write_text(json.dumps({**verify, "passed": False, "statement": "fail"}))
    page = anna.get("/runs/run/verdict")
    assert "✗ failed" in page.text
    assert ">Diagnose</button>" in page.text
    told = {
        "verdict": "confounded",
        "effects": [{"name": "cross_<b>", "channels": ["y"], "cannot_tell_from": ["other"]}],
        "next_measurement": {"why": "it tells <i>them</i> apart", "procedure": "/elsewhere"},
    }
    (judged / "diagnose.json").write_text(json.dumps(told))
    (judged / NEXT).write_text("procedure: next\n")
    page = anna.get("/runs/run/verdict")
    assert "several explain it equally" in page.text
    assert "cross &lt;b&gt; (channels y), indistinguishable from other" in page.text
    assert '<a class="button primary" href="/start?after=run">' in page.text
    assert "proposed by the diagnosis of run" in anna.get("/start?after=run").text
    eve = Browser(runs, "eve", Role.VIEWER)
    assert "Start this measurement" not in eve.get("/runs/run/verdict").text
    assert eve.post("/runs/run/diagnose").status_code == 403


@pytest.mark.parametrize(
    ("rule", "accepted", "word"),
    [
        ("simple acceptance", True, "passed"),
        ("guarded", False, "failed"),
        ("non-binary", False, "conditional pass"),
    ],
)
def test_nothing_is_conditional_under_a_binary_rule(anna, judged, rule, accepted, word):
    told = json.loads((judged / "verify.json").read_text())
    for one in (told, *told["points"]):
        one.update(statement="conditional pass", passed=accepted)
    (judged / "verify.json").write_text(json.dumps({**told, "rule": rule, "notes": []}))
    said = words(anna.get("/runs/run/verdict"))
    assert word in said
    assert ("conditional" in said) == (word == "conditional pass")


@pytest.mark.parametrize(
    "text", ["{", "[]", "null", '{"limit_g": 0, "points": []}', '{"limit_g": "x"}', "\xff", "[" * 9999]
)
@pytest.mark.parametrize("name", ["verify.json", "calibrate.json", "diagnose.json"])
def test_a_damaged_result_is_said_to_be_one(anna, runs, name, text):
    (runs / "one" / name).write_text(text, encoding="latin-1")
    page = anna.get("/runs/one/verdict")
    assert page.status_code == 200
    assert text == "null" or f"{name}: cannot be read" in page.text


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda record: record.replace(b'"bench_s": ', b'"bench_s": 1', 2), "the chain is broken here"),
        (lambda record: b"".join(record.splitlines(keepends=True)[:-9]), "the record has changed since"),
    ],
    ids=["a digit", "the end"],
)
def test_results_of_another_record_are_not_to_be_used(anna, judged, spoil, told):
    assert "Do not use" not in anna.get("/runs/run/").text + anna.get("/runs/run/verdict").text
    (judged / EVENTS).write_bytes(spoil((judged / EVENTS).read_bytes()))
    said = words(anna.get("/runs/run/verdict"))
    assert "Do not use these results: " in said
    assert told in said


def test_a_run_of_another_bench_file_is_not_to_be_used(anna, judged):
    with (judged / BENCH).open("a") as file:
        file.write("# changed\n")
    for page in ("", "verdict"):
        assert "Do not use these results: bench.yaml" in anna.get(f"/runs/run/{page}").text


def test_a_run_without_results_says_so(anna):
    assert "There is no verdict" in anna.get("/runs/one/verdict").text
    assert [
        anna.get(f"/runs/one/{name}").status_code for name in ("report", "diagnosis", "certificate/x.pdf")
    ] == [404] * 3
    assert 'href="/runs/one/">Back' in anna.get("/runs/one/view/report").text
    assert ">Back<" not in anna.get("/runs/none/verdict").text


def test_the_certificates_of_this_very_record_are_handed_out(runs, judged, tmp_path):
    shutil.copytree(ROOT / "config" / "certificate", tmp_path / "lab")
    laboratory = tmp_path / "lab" / "laboratory.yaml"
    folder = load_laboratory(laboratory).register_folder
    head = json.loads((judged / "calibrate.json").read_text())["record"]["head"]
    with opened(Register(folder)) as register:
        for number, of in (("A-1", head), ("A-2", "of another record")):
            told = {"run": "run", "record": {"head": of}, "signed_by": None}
            register.issue(
                Entry(ISSUED, number, "2026-11-22T12:00:00+00:00", "A", told), {f"{number}.pdf": b"%PDF"}
            )
        told = {"run": "run", "record": {"head": head}, "signed_by": "Laboratory"}
        register.issue(Entry(ISSUED, "A-3", "2026-11-22T12:00:00+00:00", "A", told), {"A-3.pdf": b"%PDF"})
    token = Access(runs / STATE).new_token("ben", Role.VIEWER)
    app = make_app(Settings(runs, laboratory=laboratory))
    ben = TestClient(app, base_url=HOME, follow_redirects=False)
    ben.post("/sign-in", data={"token": token}, headers=OWN)
    page = ben.get("/runs/run/verdict").text
    assert "Certificate A-1, not signed" in page
    assert "Certificate A-3:" in page
    assert "A-2" not in page
    reply = ben.get("/runs/run/certificate/A-1.pdf")
    assert (reply.content, reply.headers["content-disposition"]) == (b"%PDF", "attachment")
    assert ben.get("/runs/run/certificate/A-2.pdf").status_code == 404
    assert ben.get("/runs/one/certificate/A-1.pdf").status_code == 404
    (folder / "A-1.pdf").write_bytes(b"changed")
    assert ben.get("/runs/run/certificate/A-1.pdf").status_code == 409
    (folder / "register.jsonl").write_text("{}\n")
    assert "restore the file from a copy" in ben.get("/runs/run/verdict").text


def test_a_diagnosis_is_a_process_of_its_own(anna, judged, monkeypatch, tmp_path):
    class Started:
        status = None
        log = tmp_path / "diagnosis.log"

    Started.log.write_text("no disk")

    begun = []
    monkeypatch.setattr("bench.panel.pages.verdict.begin", lambda run: begun.append(run.name) or Started())
    for _ in range(2):
        assert anna.post("/runs/run/diagnose").headers["location"] == "/runs/run/verdict#diagnosis"
    assert begun == ["run"]
    assert "data-waiting" in anna.get("/runs/run/verdict").text
    Started.status = 2
    assert "The diagnosis failed: no disk" in anna.get("/runs/run/verdict").text
