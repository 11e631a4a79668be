"""What a release consists of: its bill of materials, its manifest, and an installation compared with it."""

import base64
import contextlib
import json
import re
import subprocess
import zipfile
from pathlib import Path

import pytest

from bench.base.files import to_text
from bench.run.seal import new_key, private_key, sign
from bench.services import validated
from bench.validation.machine import release
from bench.validation.registry import Context
from release import upgrade
from release.bill import bill, licences
from release.build import program_files, write_manifest
from tests.support.commands import without_figures

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_bill_names_every_package_with_its_licence_and_is_the_same_each_time():
    found = bill(1_700_000_000)
    assert found == bill(1_700_000_000)
    names = {one["name"].lower() for one in found["components"]}
    assert {"numpy", "scipy", "pydantic", "typer"} <= names
    assert names.isdisjoint({"pytest", "sphinx", "ruff", "uv"})
    assert all(re.fullmatch(r"pkg:pypi/[a-z0-9.-]+@\S+", one["purl"]) for one in found["components"])
    assert found["metadata"]["timestamp"] == "2023-11-14T22:13:20Z"
    assert "not stated" not in licences(found)
    needs = {one["ref"].partition("@")[0]: one["dependsOn"] for one in found["dependencies"]}
    assert len(needs) == len(found["components"]) + 1
    assert {one["bom-ref"] for one in found["components"]} >= {one for each in needs.values() for one in each}
    core = next(one["bom-ref"] for one in found["components"] if one["name"] == "pydantic_core")
    assert core in needs["pkg:pypi/pydantic"]
    assert core not in needs["pkg:pypi/triaxial-bench"]


def test_a_manifest_knows_a_program_by_the_paths_of_an_installation(tmp_path):
    wheel = tmp_path / "triaxial_bench-9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in (
            "bench/a.py",
            "bench/shipped_files/procedures/p.yaml",
            "triaxial_bench-9.9.dist-info/RECORD",
        ):
            archive.writestr(name, name)
    assert program_files(wheel).keys() == {
        "bench/a.py", "bench/shipped_files/procedures/p.yaml", "procedures/p.yaml",
    }  # fmt: skip
    write_manifest(tmp_path, wheel, None)
    found = json.loads((tmp_path / "manifest.json").read_text(encoding="utf-8"))
    assert (found["version"], list(found["files"])) == ("9.9", [wheel.name])


@pytest.fixture(scope="module")
def here():
    return validated.fingerprint()


@pytest.fixture
def released(here, tmp_path, monkeypatch):
    """Write a signed manifest of this very program; return the context of a validation against it."""
    monkeypatch.setattr("bench.validation.machine.fingerprint", lambda: here)
    key = tmp_path / "keys" / "release.pem"
    public, _ = new_key(key, None)
    manifest = {"program": here.files, "packages": {name: one.version for name, one in here.packages.items()}}
    content = to_text(manifest).encode()
    (tmp_path / "manifest.json").write_bytes(content)
    signature = sign(private_key(key, lambda: b""), content)[1]
    (tmp_path / "manifest.json.sig").write_bytes(base64.b64encode(signature))
    return Context(Path("bench.yaml"), tmp_path, release=tmp_path / "manifest.json", release_key=public)


def test_an_installation_as_released_passes(released):
    assert [(one.of, one.passed) for one in release(released)] == [
        ("signature", True), ("program files", True), ("packages", True),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "of", "where"),
    [
        ("bench/calibration/gls.py", "bench/calibration/gls_.py", "program files", "gls.py"),
        ('"numpy": "', '"numpy": "0', "packages", "changed: numpy"),
    ],
)
def test_what_differs_from_the_release_is_named(released, old, new, of, where):
    text = released.release.read_text(encoding="utf-8")
    assert old in text
    released.release.write_text(text.replace(old, new, 1), encoding="utf-8")
    wrong = {one.of: one.where for one in release(released) if not one.passed}
    assert wrong.keys() == {"signature", of}
    assert where in wrong[of]


@pytest.mark.slow(8)
def test_an_upgrade_keeps_runs_and_registers(bench, tmp_path, monkeypatch):
    """The whole list is `python -m release.upgrade`; here, what a laboratory would miss first.

    Only the earlier program needs processes of its own. `tests/cli/test_old_records.py` resumes an old run.
    """
    known = ["git", "-C", str(ROOT), "cat-file", "-e", f"{upgrade.FIRST}^{{commit}}"]
    if subprocess.run(known, capture_output=True, check=False).returncode:  # noqa: S603 - a command of our own
        pytest.skip("needs the earlier program from version control")
    by_process = upgrade.called

    def called(source, place, arguments):
        if source != ROOT:
            without_figures(source)
            return by_process(source, place, arguments)
        with contextlib.chdir(place):
            status, *said = bench(*arguments)
        return status, "".join(said)

    monkeypatch.setattr(upgrade, "called", called)
    before = [
        one for one in upgrade.OLD if one[1][0] in {"init", "run", "certificate"} and "two" not in one[1]
    ]
    after = {one for one in upgrade.NEW if one[1][:2] == ("certificate", "register") or "--verify" in one[1]}
    assert len(after) == 2
    assert upgrade.upgraded(upgrade.FIRST, tmp_path, before, sorted(after)) == []
