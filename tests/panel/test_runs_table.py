"""The table of runs and the pages on units: what stands there, what is looked for, nothing outside the folder."""

import json
import re
import shutil
import sys
from pathlib import Path

import pytest

from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.panel.access import Refusal, Role
from bench.panel.folder import UNREAD, RunsFolder, RunsTable, read_page, state_at_the_end
from bench.run.folder import Run
from bench.services.records import run_summary
from tests.support.check_runs import measured, write_bench
from tests.support.laboratory import write_run
from tests.support.pages import ROOT
from tests.support.panel_client import Browser, stranger
from tests.support.patience import PATIENCE_S

RECORDS = ROOT / "tests" / "data" / "records"


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Two runs, which a page may take as long to read as a slow machine needs."""
    monkeypatch.setattr("bench.panel.folder.LONGEST_LOOK_S", PATIENCE_S)
    folder = tmp_path / "runs"
    folder.mkdir()
    for name in ("finished", "interrupted"):
        shutil.copytree(RECORDS / name, folder / name)
    return folder


def names(reply):
    return re.findall(r'<a class="name" href="/runs/([^/"]+)/">', reply.text)


def test_each_run_has_its_state_and_how_to_go_on(runs):
    rows = {row.name: row for row in RunsTable(RunsFolder(runs)).rows()}
    assert (rows["finished"].state, rows["finished"].to_go_on) == (
        "finished",
        f"bench resume {runs / 'finished'}",
    )
    (runs / "finished" / "report.html").touch()
    assert run_summary(Run(runs / "finished")).to_go_on == ""
    assert rows["interrupted"].to_go_on == f"bench resume {runs / 'interrupted'}"
    text = Browser(runs, "anna").get("/").text
    assert ">resume</a>" in text
    assert "2 of 2 runs" in text


def test_runs_are_looked_for_by_words_and_columns(runs):
    browser = Browser(runs, "anna")
    assert names(browser.get("/?search=INTERR")) == ["interrupted"]
    assert names(browser.get("/?state=finished")) == ["finished"]
    assert names(browser.get("/?search=interr&state=finished")) == []
    assert "No run matches" in browser.get("/?search=nowhere").text


@pytest.mark.parametrize(
    "query", ["page=99999", "page=-1", "page=%00", "search=%1b%3Cscript%3E", "state=%FF&page=1e9"]
)
def test_what_is_looked_for_is_text(runs, query):
    reply = Browser(runs, "anna").get(f"/?{query}")
    assert reply.status_code == 200
    assert "<script>" not in reply.text
    assert "\x1b" not in reply.text


def test_names_of_strangers_are_text(runs):
    name = "<script>alert(1)\x1b[2J\u202e ü"
    shutil.copytree(runs / "finished", runs / name.replace("/", ""))
    browser = Browser(runs, "anna")
    text = browser.get("/").text
    assert "<script>alert" not in text
    assert "\x1b" not in text
    assert "\u202e" not in text
    (link,) = [one for one in names(browser.get("/")) if "alert" in one]
    assert browser.get(f"/runs/{link}/verdict").status_code == 200


def test_a_damaged_run_is_a_row_with_the_reason(runs):
    (runs / "finished" / "run.json").write_text("{")
    shutil.copytree(runs / "interrupted", runs / "broken")
    (runs / "broken" / "events.jsonl").write_text("rubbish\n")
    rows = {row.name: row for row in RunsTable(RunsFolder(runs)).rows()}
    assert (rows["finished"].state, rows["broken"].state) == ("damaged", "damaged")
    assert "not JSON" in rows["finished"].detail
    assert Browser(runs, "anna").get("/").status_code == 200


def test_the_page_of_a_damaged_run_says_what_to_do(runs, anna):
    (runs / "finished" / "events.jsonl").write_text("rubbish\n")
    reply = anna.get("/runs/finished/")
    assert reply.status_code == 409
    assert "The record of" in reply.text
    assert "Copy the folder of the run" in reply.text
    assert str(runs) not in reply.text
    assert '<a href="/runs/finished/">what to do</a>' in anna.get("/").text


def test_a_run_is_read_again_when_its_files_are_others_and_not_else(runs, monkeypatch):
    table = RunsTable(RunsFolder(runs))
    table.rows()
    read = []
    monkeypatch.setattr(RunsTable, "_read", lambda self, run, stamp, wait: read.append(run.name))
    monkeypatch.setattr("bench.panel.folder._now", lambda folder, row: row)
    assert len(table.rows()) == 2
    assert read == []
    (runs / "finished" / "verify.json").write_text(json.dumps({"passed": False}))
    with pytest.raises(AttributeError):
        table.rows()
    assert read == ["finished"]


def test_a_page_does_not_wait_for_thousands_of_runs_to_be_read(runs):
    class Late:
        times = 0

        def now_s(self):
            self.times += 1
            return 2.0 * PATIENCE_S * self.times

        def sleep(self, duration_s):
            raise AssertionError

    assert {row.state for row in RunsTable(RunsFolder(runs), Late()).rows()} == {UNREAD}


def test_a_page_does_not_wait_while_others_are_being_read(runs):
    table = RunsTable(RunsFolder(runs))
    with table._reading:
        assert {row.state for row in table.rows()} == {UNREAD}
    assert UNREAD not in {row.state for row in table.rows()}


def test_runs_that_are_said_to_be_read_are_read_without_a_further_page(runs, anna, monkeypatch):
    monkeypatch.setattr("bench.panel.folder.LONGEST_LOOK_S", -1.0)
    assert "2 are still being read" in anna.get("/").text
    anna.client.app.state.panel.table.read_the_rest().join()
    assert "still being read" not in anna.get("/").text


def test_two_pages_at_once_may_both_have_the_rest_read(runs):
    class Table(RunsTable):
        """A table that another page asks for the rest of the runs just before a thread starts."""

        others = 0

        def __setattr__(self, name, value):
            super().__setattr__(name, value)
            if name == "_rest" and self.others:
                self.others = 0
                self.read_the_rest().join()

    table = Table(RunsFolder(runs))
    table.others = 1
    table.read_the_rest().join()
    assert UNREAD not in {row.state for row in table.rows()}


def test_the_end_of_a_long_record_tells_whether_it_is_paused(tmp_path):
    record = tmp_path / "events.jsonl"
    lines = [{"type": "run_started"}, {"type": "run_paused"}, {"type": "x", "text": '"run_continued"'}]
    record.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert state_at_the_end(tmp_path) == "paused"
    record.write_text("y" * 200_000 + "\n" + json.dumps({"type": "step_done"}) + "\n")
    assert state_at_the_end(tmp_path) == "running"


# --- nothing outside the folder -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["..", ".", "", ".panel", "../x", "x/../y", "a\\b", "\0", "n" * 5000, "nobody"]
)
def test_a_run_is_a_folder_right_in_the_folder(runs, name):
    with pytest.raises(Refusal) as refused:
        RunsFolder(runs).run(name)
    assert refused.value.status == 404


def test_a_link_is_no_run(runs, tmp_path):
    shutil.copytree(runs / "finished", tmp_path / "outside")
    (runs / "linked").symlink_to(tmp_path / "outside")
    assert {run.name for run in RunsFolder(runs).runs()} == {"finished", "interrupted"}
    with pytest.raises(Refusal):
        RunsFolder(runs).run("linked")


def test_a_page_that_is_a_link_or_no_file_is_not_sent(runs, tmp_path):
    (tmp_path / "secret").write_text("secret")
    run = Run(runs / "finished")
    (run.folder / "report.html").unlink(missing_ok=True)
    (run.folder / "report.html").symlink_to(tmp_path / "secret")
    (run.folder / "diagnose.html").mkdir()
    for name in ("report.html", "diagnose.html", "../finished/run.json\0"):
        with pytest.raises(Refusal):
            read_page(run, name)
    assert Browser(runs, "anna").get("/runs/finished/report").status_code == 404


@pytest.mark.slow
def test_the_charts_of_the_check_block(empty_folder, monkeypatch):
    monkeypatch.delenv("BENCH_FILE", raising=False)
    write_bench()
    measured("check-0", seed=10)
    measured("check-1", seed=11)
    before = files_there()
    viewer = Browser(Path("runs"), "vera", Role.VIEWER)
    assert '<a href="/check">Check block</a>' in viewer.get("/").text
    framed = viewer.get("/check")
    assert framed.status_code == 200
    assert '<iframe class="framed" src="/check/chart"' in framed.text
    page = viewer.get("/check/chart")
    assert page.status_code == 200
    assert "Control chart of the check block" in page.text
    assert "CHECK-1" in page.text
    assert "SIMULATED" in page.text
    assert page.text.count("<svg") == 2
    assert "check-1, begun" in page.text
    assert "sandbox" in page.headers["content-security-policy"]
    none = viewer.get("/check?of=real")
    assert (none.status_code, "No check block has been measured" in none.text) == (200, True)
    assert files_there() == before


def files_there():
    """What stands in the runs, as it was written last."""
    return sorted(
        (str(file), file.stat().st_mtime_ns) for file in Path("runs").glob("check-*/**/*") if file.is_file()
    )


def test_a_stranger_sees_nothing_and_nobody_writes(tmp_path):
    assert stranger(tmp_path / "runs").get("/check").status_code in (303, 401)
    viewer = Browser(tmp_path / "runs", "vera", Role.VIEWER)
    assert viewer.post("/check").status_code == 405
    assert viewer.get("/check?of=all").status_code == 400
    none = viewer.get("/check")
    assert (none.status_code, "No check block has been measured" in none.text) == (200, True)


ADDRESSES = ("/catalogue", "/catalogue/unit/17", "/catalogue/figure/17")


@pytest.fixture
def where(tmp_path):
    for k in range(3):
        write_run(tmp_path / "all" / f"a{k}", serial="17", created=f"202{k}-03-01T08:00:00+00:00")
    write_run(tmp_path / "all" / "b", serial="<b>/18", kind="block & co", verdict="fail")
    file = tmp_path / "catalogue.sqlite"
    with open_catalogue(file) as catalogue:
        sync(catalogue, [tmp_path / "all"])
    return str(file)


@pytest.fixture
def viewer(tmp_path, where):
    return Browser(tmp_path / "runs", "vera", Role.VIEWER, where)


def test_units_are_searched_by_a_part_of_their_name_or_by_a_question(viewer):
    every = viewer.get("/catalogue").text
    assert "block A 17" in every
    assert "block &amp; co &lt;b&gt;/18" in every
    assert '<a href="/catalogue">Units</a>' in viewer.get("/").text
    assert "block A 17" not in viewer.get("/catalogue?ask=18").text
    assert "1 units" in viewer.get("/catalogue?ask=verdict=fail").text
    wrong = viewer.get("/catalogue?ask=metre=1")
    assert (wrong.status_code, "no key metre" in wrong.text) == (409, True)


def test_a_command_on_a_page_is_told_as_it_is_typed(tmp_path):
    absent = str(tmp_path / "absent.sqlite")
    told = Browser(tmp_path / "runs", "vera", Role.VIEWER, absent).get("/catalogue").text
    assert f"bench catalogue sync DIR --catalogue {absent}" in told


def test_without_its_package_a_page_says_what_installs_it(viewer, monkeypatch):
    monkeypatch.setitem(sys.modules, "sqlalchemy", None)
    shown = viewer.get("/catalogue/unit/17")
    assert shown.status_code == 409
    assert "the package sqlalchemy is not installed: pip install" in shown.text


@pytest.mark.slow
@pytest.mark.figures
def test_a_unit_has_its_coefficients_runs_and_date(viewer):
    text = viewer.get("/catalogue/unit/17").text
    assert "Due on 20" in text
    assert ">Kxx<" in text
    assert "a2" in text
    drawn = viewer.get("/catalogue/figure/block%20A%2017")
    assert drawn.headers["content-type"] == "image/svg+xml"
    assert drawn.text.startswith("<?xml")


def test_names_are_text_and_nothing_else(viewer):
    page = viewer.get("/catalogue/unit/block%20%26%20co%20%3Cb%3E%2F18")
    assert page.status_code == 200
    assert "<b>/18" not in page.text
    assert "style=" not in page.text
    assert "default-src 'none'" in page.headers["content-security-policy"]


@pytest.mark.parametrize("address", ADDRESSES)
def test_of_units_a_stranger_sees_nothing_and_nobody_writes(tmp_path, where, viewer, address):
    assert stranger(tmp_path / "runs", where).get(address).status_code in (303, 401)
    assert viewer.post(address).status_code == 405


@pytest.mark.parametrize("address", ADDRESSES)
def test_without_a_catalogue_there_are_no_such_pages(tmp_path, address):
    browser = Browser(tmp_path / "runs", "vera", Role.VIEWER)
    assert browser.get(address).status_code == 404
    assert "/catalogue" not in browser.get("/").text


def test_a_unit_that_nobody_knows_is_a_sentence(viewer):
    reply = viewer.get("/catalogue/unit/99")
    assert (reply.status_code, "no such unit" in reply.text) == (409, True)
