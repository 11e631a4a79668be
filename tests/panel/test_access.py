"""Who may come in, and what a stranger's request meets."""

import asyncio
import re
import shutil
import stat
from datetime import UTC, datetime, timedelta

import pytest

from bench.panel.access import LINKS, SESSIONS, STATE, TOKENS, Access, Role, Settings
from bench.panel.app import make_app
from bench.panel.launching import TrialResult, WantedRun, Wishes
from bench.run.events import EVENTS, RecordError
from tests.support.campaigns import seeds
from tests.support.panel_client import HOME, OWN, Browser, TestClient, stranger
from tests.support.panel_fuzz import Place, fuzz


@pytest.fixture
def client(runs):
    return stranger(runs)


# --- strangers --------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/start", "/runs/x/", "/runs/x/verdict", "/start/0123456789ab"])
def test_a_stranger_is_led_to_the_sign_in(client, path):
    reply = client.get(path)
    assert (reply.status_code, reply.headers["location"]) == (303, f"/sign-in?next={path}")


@pytest.mark.parametrize("what", ["answer", "wish", "control", "resume", "give-up", "diagnose"])
def test_a_stranger_asks_for_nothing(client, what):
    assert client.post(f"/runs/x/{what}", headers=OWN).status_code == 401
    assert client.post("/start", headers=OWN).status_code == 401


def test_a_reply_says_what_a_browser_may_do_with_it(client):
    headers = client.get("/sign-in").headers
    policy = headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert (headers["x-content-type-options"], headers["cache-control"]) == ("nosniff", "no-store")


@pytest.mark.parametrize(
    "host", ["evil.example:8741", "127.0.0.1", "127.0.0.1:80", "", "127.0.0.1:8741.evil.example"]
)
def test_a_host_of_another_name_is_refused(client, host):
    assert client.get("/sign-in", headers={"host": host}).status_code == 403


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "PROPFIND"])
def test_other_methods_are_refused(client, method):
    assert client.request(method, "/", headers=OWN).status_code == 405


def test_every_page_is_there_in_ukrainian(judged, anna):
    pages = ("/", "/start", "/queue", "/procedures", "/procedures/form?start=quick", "/bench", "/check")
    pages += ("/bench/form?start=bench-stand", "/runs/run/", "/runs/run/verdict", "/runs/run/plots")
    for path in pages:
        reply = anna.get(path, headers={"accept-language": "uk"})
        assert (path, reply.status_code) == (path, 200)
        assert "Черга</a>" in reply.text
    assert anna.get("/none", headers={"accept-language": "uk"}).status_code == 404


CHECK = {
    "procedure": "quick", "bench": "paper-stand", "steps": 70, "operator_actions": 28, "problems": [], "hints": [],
    "dry_run_refuses": [], "expected_s": 60.0, "longest_s": 60.0,
}  # fmt: skip


def test_no_english_is_left_on_ukrainian_pages(runs, judged, anna):
    said = {}
    shutil.copytree(judged, runs / "cut")
    (runs / "cut" / EVENTS).write_bytes(b"".join((judged / EVENTS).read_bytes().splitlines(True)[:-9]))
    anna.post("/queue", units="", procedure="quick", bench="paper-stand")
    wish = Wishes(runs / STATE / "wishes").new(WantedRun({"procedure": "quick.yaml", "dry_run": True}))
    wish.tell(TrialResult("done", check=CHECK, tried=0))
    for path in ("/", "/queue", "/procedures/form?start=quick", f"/start/{wish.id}"):
        page = anna.get(path, headers={"accept-language": "uk"})
        assert page.status_code == 200
        said[path] = re.sub(r"<[^>]*>", " ", page.text)
    english = {
        "unfinished",
        "of the bench file",
        "About ",
        "Before the first",
        "from quick",
        "Start the",
        " such as ",
    }
    assert [(path, words) for path in said for words in english if words in said[path]] == []
    assert "не завершено" in said["/"]
    assert "тривалість, наприклад 30 s" in said["/procedures/form?start=quick"]
    assert "Почати тренування" in said[f"/start/{wish.id}"]


# --- tokens -----------------------------------------------------------------------------------------


def test_a_token_signs_in(client, runs):
    token = Access(runs / STATE).new_token("anna", Role.OPERATOR)
    reply = client.post("/sign-in", data={"token": token}, headers=OWN)
    assert (reply.status_code, reply.headers["location"]) == (303, "/")
    assert "samesite=strict" in reply.headers["set-cookie"].lower()
    assert "httponly" in reply.headers["set-cookie"].lower()
    assert "anna" in client.get("/").text


def test_no_file_holds_a_secret_and_nobody_else_reads_them(runs):
    browser = Browser(runs, "anna")
    link = Access(runs / STATE).new_link("root")
    cookie = next(iter(browser.client.cookies.values()))
    state = runs / STATE
    assert stat.S_IMODE(state.stat().st_mode) == 0o700
    for name in (TOKENS, SESSIONS, LINKS):
        assert stat.S_IMODE((state / name).stat().st_mode) == 0o600
        text = (state / name).read_text()
        assert not [secret for secret in (browser.token, link, cookie) if secret in text]


def test_a_revoked_token_ends_its_sessions(runs):
    browser = Browser(runs, "anna")
    assert browser.get("/").status_code == 200
    Access(runs / STATE).revoke("anna")
    assert browser.get("/").status_code == 303
    with pytest.raises(RecordError, match="anna: has no token, and nobody else has one"):
        Access(runs / STATE).revoke("anna")


def test_a_person_has_one_token(runs):
    access = Access(runs / STATE)
    access.new_token("anna", Role.VIEWER)
    with pytest.raises(RecordError, match=r"'bench panel revoke anna --runs .*runs' first"):
        access.new_token(" anna ", Role.SUPERVISOR)


@pytest.mark.parametrize("name", ["", " ", "a\x1b[31m", "a\u202eb", "a\nb", "x" * 61])
def test_a_name_is_text_that_can_be_shown(runs, name):
    with pytest.raises(RecordError, match="give a name of 1 to"):
        Access(runs / STATE).new_token(name, Role.VIEWER)


def test_a_name_with_markup_is_text(runs):
    text = Browser(runs, "<b>anna</b>").get("/").text
    assert "<b>anna" not in text
    assert "&lt;b&gt;anna" in text


def test_a_session_ends_by_itself_after_a_week_and_by_signing_out(runs):
    now = datetime(2026, 1, 1, tzinfo=UTC)
    access = Access(runs / STATE, lambda: now)
    person = access.sign_in_by_token(access.new_token("anna", Role.VIEWER))
    assert access.person(person.secret) == person
    now += timedelta(days=8)
    assert access.person(person.secret) is None
    browser = Browser(runs, "ben")
    assert browser.post("/sign-out").status_code == 303
    assert browser.get("/").status_code == 303


def test_a_folder_that_is_a_link_is_no_place_for_secrets(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / STATE).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RecordError, match="a symbolic link is where the panel needs a folder"):
        Access(tmp_path / STATE)


def test_a_folder_that_others_may_read_is_closed(tmp_path):
    (tmp_path / STATE).mkdir(mode=0o755)
    (tmp_path / STATE).chmod(0o755)
    Access(tmp_path / STATE)
    assert stat.S_IMODE((tmp_path / STATE).stat().st_mode) == 0o700


# --- one-time links ---------------------------------------------------------------------------------


def test_a_link_signs_in_once_and_not_by_being_looked_at(client, runs):
    link = Access(runs / STATE).new_link("root")
    for _ in range(2):
        assert client.get(f"/sign-in?link={link}").status_code == 200
        assert not client.cookies
    reply = client.post("/sign-in", data={"link": link, "next": "/runs/unit-1/"}, headers=OWN)
    assert (reply.status_code, reply.headers["location"]) == (303, "/runs/unit-1/")
    assert "(operator)" in client.get("/").text
    again = stranger(runs).post("/sign-in", data={"link": link}, headers=OWN)
    assert again.status_code == 403
    assert "this link was used" in again.text


def test_a_link_grows_old(runs):
    now = datetime(2026, 1, 1, tzinfo=UTC)
    access = Access(runs / STATE, lambda: now)
    link = access.new_link("root")
    now += timedelta(minutes=31)
    assert access.sign_in_by_link(link) is None


def test_beyond_loopback_links_sign_nobody_in(runs):
    link = Access(runs / STATE).new_link("root")
    app = make_app(Settings(runs, "0.0.0.0"))  # noqa: S104 - nothing listens
    client = TestClient(app, base_url="http://bench.lab:8741", follow_redirects=False)
    reply = client.post("/sign-in", data={"link": link}, headers={"origin": "http://bench.lab:8741"})
    assert reply.status_code == 403


@pytest.mark.parametrize(
    "after", ["//evil.example", "https://evil.example", "/\\evil.example", "javascript:alert(1)", "/ ", ""]
)
def test_signing_in_leads_nowhere_else(client, runs, after):
    token = Access(runs / STATE).new_token("anna", Role.VIEWER)
    reply = client.post("/sign-in", data={"token": token, "next": after}, headers=OWN)
    assert reply.headers["location"] == "/"


# --- what a change must have ------------------------------------------------------------------------


ORIGINS = (None, "null", "http://evil.example", "https://127.0.0.1:8741", HOME + ".evil")


@pytest.mark.parametrize(
    ("headers", "csrf"),
    [
        *(({} if origin is None else {"origin": origin}, None) for origin in ORIGINS),
        *((OWN, csrf) for csrf in ("", "0" * 32, "é")),
    ],
)
def test_a_change_comes_from_the_panels_own_pages_and_the_same_session(runs, headers, csrf):
    browser = Browser(runs, "anna")
    sent = {"csrf": browser.csrf if csrf is None else csrf}
    assert browser.client.post("/sign-out", data=sent, headers=headers).status_code == 403
    assert browser.get("/").status_code == 200


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        (b"x" * 70_000, "application/json", 413),
        (b"{", "application/json", 400),
        (b"[1]", "application/json", 400),
        (b'{"a": 1}', "application/json", 400),
        (b'{"a": "1", "a": "2"}', "application/json", 400),
        (b"[" * 30_000, "application/json", 400),
        (b"\xff\xfe", "application/x-www-form-urlencoded", 400),
        (b"&".join([b"a=1"] * 100), "application/x-www-form-urlencoded", 400),
        (b"<a/>", "text/xml", 415),
        (b"--x", "multipart/form-data; boundary=x", 415),
    ],
)
def test_what_is_no_form_is_refused(runs, body, kind, status):
    browser = Browser(runs, "anna")
    headers = {**OWN, "content-type": kind, "x-csrf": browser.csrf}
    assert browser.client.post("/sign-out", content=body, headers=headers).status_code == status
    chunks = iter([body[k : k + 4096] for k in range(0, len(body), 4096)])
    assert browser.client.post("/sign-out", content=chunks, headers=headers).status_code == status
    assert browser.get("/").status_code == 200


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(7))
def test_requests_drawn_at_random_change_nothing_without_the_right_to(tmp_path, seed):
    outcome = asyncio.run(fuzz(Place(tmp_path), 200, seed))
    assert outcome.wrong == []
    assert outcome.requests == 200
    assert outcome.entitled > 5
    assert {200, 303, 401, 403, 404, 405, 413} <= outcome.statuses.keys()


def test_who_comes_without_a_link_types_a_token(tmp_path):
    assert 'name="token"' in stranger(tmp_path / "runs").get("/sign-in").text
    assert 'value="once"' in stranger(tmp_path / "runs").get("/sign-in?link=once").text
