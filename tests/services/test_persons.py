"""The register of persons: one identity for runs, certificates, validations, failures and the panel."""

import json
import shutil
from pathlib import Path

import pytest

from bench.certificate.laboratory import load_laboratory
from bench.panel.access import STATE, Access, Role
from bench.panel.launching import last_words, start
from bench.run.events import RecordError
from bench.run.folder import Run
from bench.services.bench_selection import origin_of_run
from bench.services.chain import LINES
from bench.services.errors import Refused
from bench.services.persons import KEY, STARTED_FROM, TOKEN, persons, persons_of
from bench.services.requests.documents import ChangePersons, PersonsCommand, Right
from tests.support.certificates import write_files
from tests.support.commands import printed, refused
from tests.support.patience import PATIENCE_S
from tests.support.schemas import keeps_to

RECORDS = Path(__file__).parents[1] / "data" / "records"


@pytest.fixture
def laboratory(tmp_path, monkeypatch):
    """A laboratory whose administrator A. Example has added B. Example, with a token, to operate."""
    for name in ("BENCH_LABORATORY", "BENCH_OPERATOR", TOKEN, KEY):
        monkeypatch.delenv(name, raising=False)
    file, _ = write_files(tmp_path)
    change(file, "add", "A. Example", may="administer, authorise, operate", role="head")
    return file


def change(laboratory, what, name, by="A. Example", **more):
    return persons(ChangePersons(PersonsCommand(what), name, by=by, laboratory=laboratory, **more))


def test_each_change_is_in_the_chain_and_no_secret_is(laboratory):
    token = change(laboratory, "add", "B. Example", may="operate", token=True).token
    result = change(laboratory, "change", "B. Example", role="technician", reason="trained")
    text = (laboratory.parent / "persons" / LINES).read_text(encoding="utf-8")
    assert token not in text
    assert [(one.kind, one.name, one.by) for one in result.changes] == [
        ("added", "A. Example", "A. Example"),
        ("added", "B. Example", "A. Example"),
        ("changed", "B. Example", "A. Example"),
    ]
    assert persons_of(laboratory).with_token(token).role == "technician"
    (laboratory.parent / "persons" / LINES).write_text(text.replace('"head"', '"cook"'), encoding="utf-8")
    with pytest.raises(Refused, match="the chain is broken"):
        persons_of(laboratory)


@pytest.mark.parametrize(
    ("what", "name", "more", "said"),
    [
        ("add", "A. Example", {}, "is in the register .* already"),
        ("change", "C. Example", {}, "is not in the register .*; use 'bench persons add'"),
        ("end", "C. Example", {"reason": "left"}, "is not in the register .*; 'bench persons' lists all"),
        ("end", "A. Example", {"reason": "left"}, "first give another person this right"),
        ("end", "A. Example", {}, "needs reason TEXT"),
        ("change", "A. Example", {"may": "operate"}, "nobody would be left .*; give may administer,operate"),
        ("add", "C. Example", {"may": "operate, cook"}, "may cook: choose from"),
        ("add", "C. Example", {"by": "Nobody"}, "by Nobody: no such person"),
        ("add", "a\nb", {}, "give a name"),
    ],
)
def test_changes_that_cannot_be(laboratory, what, name, more, said):
    before = (laboratory.parent / "persons" / LINES).read_bytes()
    with pytest.raises((Refused, RecordError), match=said):
        change(laboratory, what, name, **more)
    assert (laboratory.parent / "persons" / LINES).read_bytes() == before


def test_the_first_person_administers(tmp_path):
    file, _ = write_files(tmp_path)
    with pytest.raises(Refused, match="nobody would be left who may administer"):
        change(file, "add", "B. Example", may="operate")
    assert persons_of(file) is None


def test_the_command_that_gives_a_right_keeps_the_others(tmp_path):
    file, _ = write_files(tmp_path)
    change(file, "add", "A. Example", may="administer")
    with pytest.raises(
        Refused, match=r"'bench persons change 'A. Example' --may administer,operate --by NAME'"
    ):
        persons_of(file).chosen("A. Example", Right.OPERATE, "--operator")


# --- who acts ---------------------------------------------------------------------------------------


def test_who_authorises_is_of_the_register_and_proves_it(laboratory, monkeypatch, tmp_path):
    found = load_laboratory(laboratory)
    assert found.authorised_person("A. Example").role == "head"
    token = change(laboratory, "change", "A. Example", token=True).token
    with pytest.raises(Refused, match=f"set {TOKEN} to the token"):
        found.authorised_person("A. Example")
    monkeypatch.setenv(TOKEN, f"{token}x")
    with pytest.raises(Refused, match="must prove who acts"):
        found.authorised_person("A. Example")
    monkeypatch.setenv(TOKEN, token)
    assert found.authorised_person("A. Example").name == "A. Example"
    change(laboratory, "add", "B. Example", may="operate")
    with pytest.raises(Refused, match=r"may not authorise in .*; name one who may authorise: A. Example"):
        found.authorised_person("B. Example")


def test_a_key_proves_it_too(laboratory, monkeypatch, tmp_path):
    from bench.run.seal import new_key

    mine, other = tmp_path / "k" / "mine.pem", tmp_path / "k" / "other.pem"
    public, _ = new_key(mine, None)
    new_key(other, None)
    change(laboratory, "change", "A. Example", public_key=public)
    found = load_laboratory(laboratory)
    for file in (None, other):
        if file is not None:
            monkeypatch.setenv(KEY, str(file))
        with pytest.raises(Refused, match=f"set {KEY} to the key file"):
            found.authorised_person("A. Example")
    monkeypatch.setenv(KEY, str(mine))
    assert found.authorised_person("A. Example").name == "A. Example"


def test_ended_rights_leave_the_past_readable(laboratory):
    change(laboratory, "add", "B. Example", may="operate, authorise", role="deputy")
    change(laboratory, "end", "B. Example", reason="retired")
    register = persons_of(laboratory)
    assert (register.everyone["B. Example"].role, register.who_may(Right.OPERATE)[0].name) == (
        "deputy",
        "A. Example",
    )
    with pytest.raises(Refused, match="rights ended on"):
        load_laboratory(laboratory).authorised_person("B. Example")
    change(laboratory, "add", "B. Example", may="operate", reason="is back")
    assert {one.name for one in persons_of(laboratory).who_may(Right.OPERATE)} == {"A. Example", "B. Example"}


# --- runs -------------------------------------------------------------------------------------------


def test_an_operator_is_picked_and_the_record_keeps_what_was_known(bench, laboratory):
    more = ("--laboratory", laboratory)
    assert "no such person" in refused(bench("run", "quick", "--dry-run", "--operator", "Anna", *more))
    printed(bench("run", "quick", "--dry-run", "--name", "one", "--operator", "A. Example", *more))
    about = json.loads(Path("runs/one/run.json").read_text(encoding="utf-8"))
    assert about["operator_person"] == {
        "role": "head",
        "may": ["administer", "authorise", "operate"],
        "register": persons_of(laboratory).head,
    }
    said = refused(bench("run", "quick", "--bench", "bench-lan", *more))
    assert "give --operator NAME, one of: A. Example" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("named", "register", "by"),
    [
        ("", False, None),
        ("Anna", False, "Anna"),
        ("A. Example", True, "A. Example"),
        ("Anna", True, "refused"),
    ],
)
def test_who_resumes_a_run_is_in_its_record(bench, laboratory, monkeypatch, named, register, by):
    shutil.copytree(RECORDS / "interrupted", "runs/one")
    if register:
        monkeypatch.setenv("BENCH_LABORATORY", str(laboratory))
    answer = bench("resume", "one", *(["--operator", named] if named else []))
    if by == "refused":
        assert "no such person" in refused(answer)
        return
    assert answer[0] == 0
    history = Run(Path("runs/one")).history
    (event,) = (one for one in history.events if one.type == "run_resumed")
    assert (event.data.get("by"), history.problems) == (by, ())
    assert {"by", "role", "where"}.isdisjoint(event.data) == (by is None)
    began = Run(Path("runs/one")).manifest["operator"]
    operators = ", ".join(filter(None, dict.fromkeys([began, by])))
    assert origin_of_run(Run(Path("runs/one"))).origin.operator == operators
    assert (f"operator: {operators}" in printed(bench("show", "one"))) == bool(operators)


@pytest.mark.parametrize(
    ("started_from", "where", "role"),
    [
        ("", "terminal", "supervisor"),
        ("panel", "panel", "supervisor"),
        ("panel operator", "panel", "operator"),
    ],
)
def test_who_resumes_at_a_shell_is_at_the_terminal_wherever_the_answers_come_from(
    bench, empty_folder, monkeypatch, started_from, where, role
):
    if started_from:
        monkeypatch.setenv(STARTED_FROM, started_from)
    shutil.copytree(RECORDS / "interrupted", "runs/one")
    assert bench("resume", "one", "--operator", "Anna", "--answers", "folder")[0] == 0
    (event,) = (one for one in Run(Path("runs/one")).history.events if one.type == "run_resumed")
    assert (event.data["by"], event.data["where"], event.data["role"]) == ("Anna", where, role)


def test_what_the_panel_starts_knows_that_it_is_from_there(tmp_path):
    says = f"import os; print(os.environ['{STARTED_FROM}'])"
    for role, told in (("", "panel"), ("operator", "panel operator")):
        started = start([], tmp_path / "log", program=("-c", says), role=role)
        assert started.process.wait(PATIENCE_S) == 0
        assert last_words(started.log) == told


def test_the_command_lists_and_changes(bench, laboratory):
    more = ("--laboratory", laboratory)
    out = printed(
        bench("persons", "add", "B. Example", "--may", "operate", "--token", "--by", "A. Example", *more)
    )
    assert "the token, shown only now: " in out
    out = printed(bench("persons", "--json", "persons.json", *more))
    assert "B. Example" in out
    result = json.loads(Path("persons.json").read_text(encoding="utf-8"))
    keeps_to("persons", result)
    assert result["token"] is None


def test_failures_are_noted_by_persons(bench, laboratory):
    Path("runs").mkdir()
    said = refused(bench("failures", "--laboratory", laboratory, "--number", "F2026-0001", "--state", "remedied",
                         "--remedy", "r", "--by", "Anna"))  # fmt: skip
    assert "no failure of that number" in said


# --- the panel --------------------------------------------------------------------------------------


def test_the_panel_knows_the_same_persons(laboratory, tmp_path):
    token = change(laboratory, "add", "B. Example", may="operate", token=True).token
    access = Access(tmp_path / STATE, laboratory=laboratory)
    found = access.sign_in_by_token(token)
    assert (found.name, found.role) == ("B. Example", Role.OPERATOR)
    assert [row["name"] for row in access.tokens()] == ["B. Example"]
    change(laboratory, "change", "B. Example", may="operate, supervise")
    assert access.person(found.secret).role is Role.SUPERVISOR
    linked = access.sign_in_by_link(access.new_link("B. Example"))
    assert linked.role is Role.OPERATOR
    change(laboratory, "end", "B. Example", reason="left")
    assert access.person(found.secret) is None
    assert access.person(linked.secret) is None
    assert access.sign_in_by_token(token) is None
    with pytest.raises(Refused, match="a link for root: no such person"):
        access.new_link("root")
    with pytest.raises(RecordError, match="use 'bench persons change NAME --token'"):
        access.new_token("anna", Role.VIEWER)


def test_tokens_of_the_panel_count_no_longer_once_the_register_stands(tmp_path, monkeypatch):
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    file, _ = write_files(tmp_path)
    access = Access(tmp_path / STATE, laboratory=file)
    token = access.new_token("anna", Role.OPERATOR)
    signed_in = access.sign_in_by_token(token)
    assert access.person(signed_in.secret).name == "anna"
    change(file, "add", "A. Example", may="administer")
    assert access.person(signed_in.secret) is None
    assert access.sign_in_by_token(token) is None
