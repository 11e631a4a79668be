"""Seals: what `show --verify` tells with them, and without, of a record that was changed by who knows how."""

import hashlib
import json
import os
import shutil
import stat
from pathlib import Path

import pytest

from bench.run.events import EVENTS, MANIFEST
from tests.support.commands import printed, refused
from tests.support.time_authority import Authority, Served

RECORDS = Path(__file__).parents[1] / "data" / "records"
NOTHING_OUTSIDE = "this check does not show removed last lines"


@pytest.fixture
def run(bench):
    """A finished run as `runs/one`."""
    shutil.copytree(RECORDS / "finished", "runs/one")
    return Path("runs/one")


@pytest.fixture
def key(bench):
    assert bench("key", "keys/lab.pem")[0] == 0
    return "keys/lab.pem"


def last_line_off(folder):
    lines = (folder / EVENTS).read_bytes().splitlines(keepends=True)
    (folder / EVENTS).write_bytes(b"".join(lines[:-1]))


def chain_anew(folder):
    """Change the operator, and compute the whole chain again over it."""
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["operator"] = "Somebody Else"
    (folder / MANIFEST).write_text(json.dumps(manifest))
    previous = hashlib.sha256((folder / MANIFEST).read_bytes()).hexdigest()
    written = b""
    for line in (folder / EVENTS).read_bytes().splitlines():
        new = json.dumps({**json.loads(line), "prev": previous}, ensure_ascii=False).encode()
        previous = hashlib.sha256(new).hexdigest()
        written += new + b"\n"
    (folder / EVENTS).write_bytes(written)


ATTACKS = [last_line_off, chain_anew]


def head_of(folder):
    return hashlib.sha256((folder / EVENTS).read_bytes().splitlines()[-1]).hexdigest()


@pytest.mark.parametrize("attack", ATTACKS)
def test_without_anything_outside_the_folder_it_is_said_that_such_changes_do_not_show(bench, run, attack):
    attack(run)
    printed(bench("show", "one", "--verify"), "chain of hashes complete", NOTHING_OUTSIDE, "no seal")


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_head_noted_elsewhere_betrays_them(bench, run, attack):
    (result,) = [json.loads(bench("calibrate", "one", "--json", "-")[1])]
    assert result["record"] == {"events": 142, "head": head_of(run)}
    head = result["record"]["head"]
    out = printed(bench("show", "one", "--verify", "--head", head), "the head equals the given one")
    assert NOTHING_OUTSIDE not in out
    attack(run)
    printed(
        bench("show", "one", "--verify", "--head", head),
        "the hash of the record's last line differs from the given one",
        status=1,
    )


def test_a_head_that_is_none_is_refused(bench, run):
    assert bench("show", "one", "--head", "12ab")[2].startswith("bench: --head 12ab: give the SHA-256")


@pytest.mark.parametrize("attack", ATTACKS)
def test_an_unsigned_seal_shows_changes_of_who_forgot_it_and_claims_no_more(bench, run, attack):
    assert bench("seal", "one")[0] == 0
    printed(
        bench("show", "one", "--verify"),
        "not signed: anybody who can write the folder could have made this seal",
        NOTHING_OUTSIDE,
    )
    attack(run)
    printed(bench("show", "one", "--verify"), "the record changed after it was sealed", status=1)
    refused(bench("seal", "one"), "not sealed again")


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_signed_seal_says_by_whom(bench, run, key, attack):
    assert bench("seal", "one", "--key", key)[0] == 0
    assert "--key FILE checks whose key it is" in bench("show", "one", "--verify")[1]
    out = printed(bench("show", "one", "--verify", "--key", f"{key}.pub"), "signed with the given key")
    assert NOTHING_OUTSIDE not in out
    attack(run)
    assert bench("show", "one", "--key", f"{key}.pub")[0] == 1
    (run / "seal.json").unlink()
    assert bench("seal", "one")[0] == (0 if attack is chain_anew else 2)  # its end is missing: it goes on
    out = printed(bench("show", "one", "--key", f"{key}.pub"), status=1)
    assert "no signature for --key to check" in out or "no seal for --key" in out


def test_another_key_and_a_changed_seal_are_told(bench, run, key):
    assert bench("key", "keys/other.pem")[0] == 0
    assert bench("seal", "one", "--key", "keys/other.pem")[0] == 0
    printed(
        bench("show", "one", "--key", f"{key}.pub"), "signed with another key than the given one", status=1
    )
    seal = json.loads((run / "seal.json").read_text())
    seal["sealed"] = "2020-01-01T00:00:00+00:00"
    (run / "seal.json").write_text(json.dumps(seal))
    printed(
        bench("show", "one", "--key", "keys/other.pem.pub"),
        "the signature does not belong to this seal",
        status=1,
    )


@pytest.mark.parametrize(
    "text", ["", "[]", '{"format": 1}', "[" * 100_000, '{"format": 1, "files": {}, "events": Infinity}']
)
def test_a_damaged_seal_is_told(bench, run, text):
    (run / "seal.json").write_text(text)
    printed(bench("show", "one", "--verify"), "seal.json: damaged (not a seal)", status=1)


def test_a_run_that_has_not_ended_is_not_sealed(bench):
    shutil.copytree(RECORDS / "interrupted", "runs/open")
    refused(bench("seal", "open"), "the run is interrupted, and only an ended run can be sealed")
    assert not Path("runs/open/seal.json").exists()


# --- keys -------------------------------------------------------------------------------------------


def test_a_key_is_for_its_owner_alone_and_never_written_over(bench, key):
    assert stat.S_IMODE(Path(key).stat().st_mode) == 0o600
    assert stat.S_IMODE(Path("keys").stat().st_mode) == 0o700
    assert b"BEGIN PRIVATE KEY" in Path(key).read_bytes()
    assert b"BEGIN PUBLIC KEY" in Path(f"{key}.pub").read_bytes()
    before = Path(key).read_bytes()
    assert "a file of that name exists" in bench("key", key)[2]
    assert Path(key).read_bytes() == before


@pytest.mark.skipif(os.name != "posix", reason="modes of files are POSIX's")
@pytest.mark.parametrize(
    ("name", "mode", "words"), [("keys/lab.pem", 0o640, "chmod 600"), ("keys", 0o755, "chmod 700")]
)
def test_a_key_that_others_may_use_is_refused(bench, run, key, name, mode, words):
    Path(name).chmod(mode)
    refused(bench("seal", "one", "--key", key), words)
    assert not (run / "seal.json").exists()


def test_an_incomplete_line_after_the_end_is_deleted_before_the_run_is_sealed(bench, run):
    whole = (run / EVENTS).read_bytes()
    (run / EVENTS).write_bytes(whole + b'{"n": 99')
    refused(bench("seal", "one"), f"runs/one/{EVENTS}: an incomplete line follows the end of the run")
    (run / EVENTS).write_bytes(whole)
    assert bench("seal", "one")[0] == 0


def test_a_key_with_a_passphrase_is_used_with_it_alone(bench, run):
    assert bench("key", "keys/lab.pem", "--passphrase", stdin="word\nother\n")[0] == 2
    assert bench("key", "keys/lab.pem", "--passphrase", stdin="word\nword\n")[0] == 0
    assert b"ENCRYPTED" in Path("keys/lab.pem").read_bytes()
    assert "a wrong passphrase" in bench("seal", "one", "--key", "keys/lab.pem", stdin="wrong\n")[2]
    assert bench("seal", "one", "--key", "keys/lab.pem", stdin="word\n")[0] == 0
    assert bench("show", "one", "--key", "keys/lab.pem.pub")[0] == 0


@pytest.mark.parametrize(
    "text", ["", "no key", "-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n"]
)
def test_what_is_no_key_is_told(bench, run, key, text):
    Path("keys/none.pem").write_text(text)
    Path("keys/none.pem").chmod(0o600)
    err = bench("seal", "one", "--key", "keys/none.pem")[2]
    assert "not a private key (Ed25519, PEM; 'bench key FILE' makes one)" in err
    assert "not a public key" in bench("show", "one", "--key", "keys/none.pem")[2]


# --- time stamps ------------------------------------------------------------------------------------


def test_a_time_stamp_says_not_later_than_when(bench, run, key):
    authority = Authority()
    Path("authority.pem").write_bytes(authority.pem())
    Path("other.pem").write_bytes(Authority().pem())
    with Served(authority) as served:
        assert bench("seal", "one", "--key", key, "--timestamp", served.url)[0] == 0
    ((kind, _),) = authority.requests
    assert kind == "application/timestamp-query"
    assert "--authority FILE checks who issued it" in bench("show", "one", "--verify")[1]
    out = printed(
        bench("show", "one", "--verify", "--authority", "authority.pem"),
        "the record existed by 2026-03-01T12:00:00+00:00",
    )
    assert NOTHING_OUTSIDE not in out
    printed(
        bench("show", "one", "--authority", "other.pem"), "not signed by the authority in other.pem", status=1
    )
    assert len(authority.requests) == 1  # to verify asks nobody


def test_a_time_stamp_of_something_else_is_told(bench, run, key):
    with Served(Authority()) as served:
        bench("seal", "one", "--timestamp", served.url)
    stamp = json.loads((run / "seal.json").read_text())["time_stamp"]
    bench("seal", "one", "--key", key)
    seal = json.loads((run / "seal.json").read_text())
    (run / "seal.json").write_text(json.dumps({**seal, "time_stamp": stamp}))
    printed(bench("show", "one", "--verify"), "the time stamp belongs to another seal", status=1)


def of_before(authority):
    """Answers for the request of another."""
    with Served(authority) as served:
        from bench.run.seal import ask_time_stamp

        earlier = ask_time_stamp(served.url, b"another message")
    return lambda request: earlier


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda authority: lambda request: b"<html>", "unexpected answer"),
        (lambda authority: lambda request: b"", "unexpected answer"),
        (of_before, "the server stamped other data"),
    ],
)
def test_an_answer_that_is_no_time_stamp_leaves_the_seal_without(bench, run, answer, why):
    authority = Authority()
    authority.answer = answer(authority)
    with Served(authority) as served:
        status, _, err = bench("seal", "one", "--timestamp", served.url)
    assert status == 1
    assert why in err
    assert "the seal has no time stamp" in err
    assert bench("show", "one", "--verify")[0] == 0


def test_a_server_that_is_not_there_leaves_the_seal_without(bench, run):
    with Served(Authority()) as served:
        pass
    status, _, err = bench("seal", "one", "--timestamp", served.url)
    assert status == 1
    assert err.count("\n") == 1
    assert "no time stamp" in err
    assert (run / "seal.json").exists()


@pytest.mark.parametrize("url", ["file:///etc/passwd", "stamps.example", "http://"])
def test_what_is_no_server_is_refused(bench, run, url):
    assert "give the address of a server" in bench("seal", "one", "--timestamp", url)[2]
    assert not (run / "seal.json").exists()
