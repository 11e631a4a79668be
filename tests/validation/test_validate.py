"""`bench validate` from the command line: files, exit status, acceptance; with a few of its checks."""

import json
from itertools import islice
from pathlib import Path

import pytest

from bench.run.events import sha256
from bench.run.seal import read_seal
from bench.services import validated
from bench.validation import acceptance, conduct, registry
from bench.validation.records import write_files
from bench.validation.registry import TABLE, Check, Finding
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to

pytestmark = pytest.mark.slow

FEW = ("changes since the accepted validation",)
BY = ("--by", "A. Example", "--reason", "first use")


@pytest.fixture
def few(monkeypatch):
    """Let a validation be of a few checks, and a fingerprint of a few packages; return the list of further checks.

    `test_register.py` has the whole fingerprint.
    """
    packages = validated.packages
    monkeypatch.setattr(validated, "packages", lambda: islice(packages(), 3))
    registry.every()
    others = []
    chosen = [
        one for one in TABLE if one.family in FEW or one.name in {"locale", "run length of an EWMA chart"}
    ]
    monkeypatch.setattr(conduct, "every", lambda: [*chosen, *others])
    return others


@pytest.fixture
def laboratory(empty_folder, monkeypatch):
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    return write_files(Path())[0]


def broken(context):
    """Fail."""
    raise ValueError("no")


def test_a_validation_is_written_sealed_accepted_and_compared(bench, few, laboratory):
    out = printed(
        bench("validate", "--quick", "--out", "v1", "--laboratory", laboratory, "--json", "r.json"), "PASSED"
    )
    assert "v1/validation.pdf" in out
    result = json.loads(Path("r.json").read_text(encoding="utf-8"))
    keeps_to("validate", result)
    assert result["passed"] is True
    assert {"name", "clause", "expected", "found", "passed"} <= result["checks"][0].keys()
    assert conduct.damage_of(Path("v1"), read_seal(Path("v1"))) == []
    assert Path("v1/validation.pdf").read_bytes().startswith(b"%PDF")
    assert "What this does not prove" in Path("v1/validation.html").read_text(encoding="utf-8")

    lab = ("--laboratory", laboratory)
    refused(
        bench("validate", "--accept", "v1", *lab, "--by", "Somebody", "--reason", "x"),
        "--by Somebody",
        "choose one of them",
    )
    refused(bench("validate", "--accept", "v1", *lab), "--by NAME and --reason TEXT")
    refused(bench("validate", "--accept", "v1", *BY), "--laboratory FILE")
    printed(
        bench("validate", "--accept", "v1", *lab, *BY),
        "accepted by A. Example: first use",
        ", quick)",
        "1 entries",
    )
    refused(bench("validate", "--accept", "v1", *lab, *BY), "registered already")

    file = Path("mine.yaml")
    file.write_text(
        Path(result["bench"]["file"]).read_text(encoding="utf-8") + "\n# changed\n", encoding="utf-8"
    )
    out = printed(bench("validate", "--quick", "--out", "v2", "--bench", file, *lab), "PASSED")
    printed(bench("validate", "--accept", "v2", *lab, *BY), "V")
    file.write_text(file.read_text(encoding="utf-8") + "# again\n", encoding="utf-8")
    out = printed(
        bench("validate", "--quick", "--out", "v3", "--bench", file, *lab), "CHANGED: 1 of", status=1
    )
    assert "bench file" in out
    number = printed(bench("validate", "--accept", "v3", *lab, *BY)).splitlines()[-2].split()[0]
    printed(bench("validate", "--quick", "--out", "v4", "--bench", file, *lab), "PASSED")
    printed(bench("validate", "--withdraw", number, *lab, *BY), f"{number}", "withdrawn by A. Example")
    entries = printed(bench("validate", "--register", *lab, "--json", "register.json"))
    keeps_to("validate-register", json.loads(Path("register.json").read_text(encoding="utf-8")))
    assert "4 entries" in entries


def test_a_file_that_is_no_bench_file_is_refused_before_the_checks(bench, few):
    def reached(context):
        """Fail."""
        raise AssertionError("a check was carried out")

    few.append(Check("reached", "machine", "7.11.2", "any", reached))
    Path("odd.yaml").write_text("hello: world\n", encoding="utf-8")
    refused(bench("validate", "--bench", "odd.yaml", "--out", "v"), "odd.yaml:1: 'stand' is missing", lines=6)
    assert not Path("v").exists()


def test_a_failed_check_names_its_place_and_cannot_be_accepted(bench, few, laboratory):
    few.append(Check("a broken thing", "machine", "7.11.2", "to work", broken, place="bench/somewhere.py"))
    out = printed(
        bench("validate", "--out", "v"), "NOT VALID: 1 of", "a broken thing", "bench/somewhere.py", status=1
    )
    assert "PASSED" not in out
    refused(
        bench("validate", "--accept", "v", "--laboratory", laboratory, *BY),
        "1 checks failed (a broken thing)",
    )


def test_a_failed_validation_is_in_the_register_of_failures(bench, few, laboratory):
    few.append(Check("a broken thing", "machine", "7.11.2", "to work", broken))
    lab = ("--laboratory", laboratory)
    printed(bench("validate", "--out", "v", *lab), "in the register of failures: F", status=1)
    number = json.loads(Path("v/validation.json").read_text(encoding="utf-8"))["failure"]
    note = ("--number", number, "--state", "remedied", "--remedy", "mended", "--by", "A. Example")
    printed(bench("failures", *lab, *note, "--json", "f.json"), "a broken thing", "0 of them new")
    (one,) = json.loads(Path("f.json").read_text(encoding="utf-8"))["failures"]
    assert (one["number"], one["kind"], one["run"], one["state"]) == (number, "validation", "v", "remedied")


def test_a_register_of_failures_that_cannot_be_written_does_not_cost_the_result(bench, few, laboratory):
    few.append(Check("a broken thing", "machine", "7.11.2", "to work", broken))
    Path("failures").write_text("no folder", encoding="utf-8")
    printed(bench("validate", "--out", "v", "--laboratory", laboratory), "failures: cannot be", status=1)
    assert Path("v/seal.json").is_file()


def test_a_signed_seal_that_was_edited_cannot_be_accepted(bench, few, laboratory):
    Path("keys").mkdir(mode=0o700)
    printed(bench("key", "keys/lab.pem"))
    printed(bench("validate", "--out", "v", "--key", "keys/lab.pem"))
    file, seal = Path("v/validation.html"), Path("v/seal.json")
    before = sha256(file.read_bytes())
    file.write_bytes(file.read_bytes() + b" ")
    text = seal.read_text(encoding="utf-8").replace(before, sha256(file.read_bytes()))
    seal.write_text(text, encoding="utf-8")
    refused(
        bench("validate", "--accept", "v", "--laboratory", laboratory, *BY),
        "not signed with the key that it names",
    )


def test_what_was_changed_between_validation_and_acceptance_is_named(bench, few, laboratory, monkeypatch):
    printed(bench("validate", "--out", "v"))
    here = acceptance.fingerprint()
    files = {**here.files, "bench/new.py": "0"}
    now = here.model_copy(update={"fingerprint": "0", "files": files})
    monkeypatch.setattr(acceptance, "fingerprint", lambda: now)
    accept = ("validate", "--accept", "v", "--laboratory", laboratory, *BY)
    refused(bench(*accept), "changed since (new: bench/new.py)")


def test_a_result_that_was_edited_cannot_be_accepted(bench, few, laboratory):
    printed(bench("validate", "--out", "v"))
    refused(bench("validate", "--out", "v"), "holds a validation already")
    file = Path("v/validation.json")
    file.write_text(file.read_text(encoding="utf-8").replace("11.1", "11.2", 1), encoding="utf-8")
    refused(
        bench("validate", "--accept", "v", "--laboratory", laboratory, *BY), "differs from the sealed file"
    )


def test_names_in_other_letters_and_control_characters_get_a_page_and_a_pdf(bench, few):
    def strange(context):
        """Find strange letters."""
        return Finding(True, "\x16 ⵣ")

    few.append(Check("letters", "machine", "7.11.2", "any", strange))
    printed(bench("validate", "--out", "v"))
    assert Path("v/validation.pdf").read_bytes().startswith(b"%PDF")
