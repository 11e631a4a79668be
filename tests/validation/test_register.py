"""The register of validations, its writers and kills, and the refusal that a laboratory or bench file demands."""

import json
import multiprocessing
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from bench.base.yaml_files import sha256_of_file
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.run.events import EVENTS
from bench.run.folder import Run
from bench.services import validated
from bench.services.chain import LINES, Entry, opened
from bench.services.errors import Refused
from bench.services.execution import new_run
from bench.services.requests.measuring import RunRequest
from bench.services.validated import ACCEPTED, WITHDRAWN, Validations
from bench.validation.records import write_files
from bench.validation.registry import Context, carry_out, every
from tests.support.commands import refused

FORK = multiprocessing.get_context("fork")


def entry(number, program="p", bench_sha256="b", kind=ACCEPTED):
    data = {"fingerprint": program, "bench": "bench.yaml", "bench_sha256": bench_sha256, "result_sha256": "r",
            "role": None, "reason": "because"}  # fmt: skip
    return Entry(kind, number, "2026-11-24T08:00:00+00:00", "A. Example", data)


def test_an_entry_can_be_withdrawn_once(tmp_path):
    with opened(Validations(tmp_path)) as register:
        register.append(entry("1"))
        assert register.accepts("p", "b")
        assert register.accepts("p", None)
        assert not register.accepts("p", "another")
        register.append(entry("1", kind=WITHDRAWN))
        assert not register.accepts("p", None)
        for again in (entry("1", kind=WITHDRAWN), entry("1")):
            with pytest.raises(Refused, match="contradicts the entries before it"):
                register.append(again)


def test_a_changed_line_is_refused_with_its_number(tmp_path):
    with opened(Validations(tmp_path)) as register:
        register.append(entry("1"))
        register.append(entry("2"))
    lines = (tmp_path / LINES).read_text(encoding="utf-8")
    (tmp_path / LINES).write_text(lines.replace("because", "BECAUSE", 1), encoding="utf-8")
    with pytest.raises(Refused, match="line 2: the chain is broken"), opened(Validations(tmp_path)):
        pass


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills are those of POSIX")
def test_two_writers_and_kills_lose_nothing(tmp_path):
    """Two programs append at once and are killed three times: what was said to be written is there, in order."""
    folder = tmp_path / "register"
    for _ in range(3):
        before = (folder / LINES).stat().st_size if (folder / LINES).exists() else 0
        writers = [FORK.Process(target=append_for_ever, args=(folder, f"{mark}{before}")) for mark in "ab"]
        for writer in writers:
            writer.start()
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and _size(folder) < before + 3000:
            time.sleep(0.01)
        for writer in writers:
            os.kill(writer.pid, signal.SIGKILL)
            writer.join()
    said = [name for file in tmp_path.glob("said-*") for name in file.read_text("utf-8").split()]
    with opened(Validations(folder)) as register:
        assert len(said) > 10  # an entry has about 450 bytes; of each writer one may be noted no more
        assert set(said) <= {one.number for one in register.entries}


def append_for_ever(folder, mark):
    """Append entries to a register of validations; note each one beside it once it is written."""
    with folder.with_name(f"said-{mark}").open("a", encoding="utf-8") as said:
        for number in range(1_000_000):
            with opened(Validations(folder)) as register:
                register.append(entry(f"{mark}-{number}"))
            said.write(f"{mark}-{number}\n")
            said.flush()


def _size(folder):
    return (folder / LINES).stat().st_size if (folder / LINES).exists() else 0


# --- the refusal ------------------------------------------------------------------------------------


@pytest.fixture
def demanding(tmp_path, monkeypatch):
    """A laboratory that demands validations, and a bench file beside it."""
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    monkeypatch.setattr(validated, "fingerprint", lambda: FINGERPRINT)
    laboratory, _ = write_files(tmp_path, {"require_validation": True})
    bench = Path(shutil.copy(find_bench("bench-lan"), tmp_path / "bench.yaml"))
    return laboratory, bench


class FINGERPRINT:
    """The fingerprint of a program that does not take half a second."""

    fingerprint = "f" * 64


def refusal(laboratory, bench):
    with pytest.raises(Refused) as refused:
        validated.refuse_unvalidated_run(load_bench(bench), bench, laboratory)
    return refused.value.typed


def test_a_demanding_laboratory_refuses_until_somebody_accepted(demanding):
    laboratory, bench = demanding
    said = refusal(laboratory, bench)
    assert "no validation was accepted yet" in said
    assert f"bench validate --bench {bench} --laboratory {laboratory}" in said
    folder = Validations.beside(laboratory).folder
    with opened(Validations(folder)) as register:
        register.append(entry("1", "old program", "old file"))
    assert "the program was changed since 1 was accepted" in refusal(laboratory, bench)
    with opened(Validations(folder)) as register:
        register.append(entry("2", "f" * 64, "old file"))
    assert "was changed since, or never validated" in refusal(laboratory, bench)
    with opened(Validations(folder)) as register:
        register.append(entry("3", "f" * 64, sha256_of_file(bench)))
    validated.refuse_unvalidated_run(load_bench(bench), bench, laboratory)
    validated.refuse_unvalidated_certificate(laboratory)
    with opened(Validations(folder)) as register:
        register.append(entry("3", "f" * 64, sha256_of_file(bench), WITHDRAWN))
    assert "was changed since, or never validated" in refusal(laboratory, bench)


def test_a_bench_file_can_demand_it_too(demanding, bench):
    _, file = demanding
    file.write_text(file.read_text(encoding="utf-8") + "\nrequire_validation: yes\n", encoding="utf-8")
    status, _, err = bench("run", "quick", "--bench", file)
    assert status == 2
    assert "demands a validated program (require_validation)" in err
    assert "--laboratory FILE" in err
    status, _, err = bench("check", "quick", "--bench", file)
    assert (status, err) == (0, "")


def test_a_real_run_is_not_continued_by_a_program_that_nobody_validated(
    demanding, bench, empty_folder, monkeypatch
):
    laboratory, file = demanding
    monkeypatch.setattr(os, "isatty", lambda _: True)
    monkeypatch.setenv("BENCH_LABORATORY", str(laboratory))
    folder = Validations.beside(laboratory).folder
    with opened(Validations(folder)) as register:
        register.append(entry("1", "f" * 64, sha256_of_file(file)))
    new = new_run(RunRequest("quick", str(file), name="real"))
    new.record().close()
    with opened(Validations(folder)) as register:
        register.append(entry("1", "f" * 64, sha256_of_file(file), WITHDRAWN))
        register.append(entry("2", "older program", sha256_of_file(file)))
    before = (new.folder / EVENTS).read_bytes()
    said = refused(bench("resume", "real"), "the program was changed since 2 was accepted")
    assert f"--bench {new.folder / 'bench.yaml'}" in said
    assert (new.folder / EVENTS).read_bytes() == before
    dry = new_run(RunRequest("quick", str(file), name="dry", dry_run=True))
    dry.record().close()
    validated.refuse_unvalidated_resumption(Run(dry.folder))


OWN = Path(__file__).parents[2] / "docs" / "examples" / "turnwell"


def test_a_driver_of_the_laboratory_is_part_of_what_was_validated(demanding, tmp_path, monkeypatch):
    laboratory, file = demanding
    drivers = shutil.copytree(OWN, tmp_path / "drivers")
    monkeypatch.setenv("BENCH_DEVICES", str(drivers))
    monkeypatch.setattr(validated, "foreign_drivers", lambda _: {"turnwell": "a file"})
    own = validated.plug_ins(load_bench(file))
    assert own
    assert all(name.startswith("drivers/") for name in own)
    data = {**entry("1", "f" * 64, sha256_of_file(file)).data, "plug_ins": validated.digest_of(own)}
    with opened(Validations.beside(laboratory)) as register:
        register.append(replace(entry("1"), data=data))
    validated.refuse_unvalidated_run(load_bench(file), file, laboratory)
    one = next(drivers.rglob("*.py"))
    one.write_text(one.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    assert "a driver or effect of your own" in refusal(laboratory, file)
    accepted = {"bench": {"plug_ins": own}}
    (row,) = carry_out(
        Context(file, tmp_path, accepted=accepted),
        [one for one in every() if one.name == "own drivers and effects"],
    )
    assert (row.passed, row.where) == (False, f"changed: drivers/{one.relative_to(drivers).as_posix()}")


def test_who_demands_nothing_is_not_asked(tmp_path, monkeypatch):
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    laboratory, _ = write_files(tmp_path)
    validated.refuse_unvalidated_run(load_bench(find_bench("bench-lan")), find_bench("bench-lan"), laboratory)
    validated.refuse_unvalidated_certificate(laboratory)


@pytest.mark.slow
def test_the_fingerprint_is_of_files_packages_and_python():
    found = validated.fingerprint()
    assert "bench/calibration/gls.py" in found.files
    assert "procedures/quick.yaml" in found.files
    assert {"numpy", "scipy", "pydantic"} <= found.packages.keys()
    assert "pytest" not in found.packages
    assert json.dumps(found.to_dict())
    assert found.fingerprint == validated.fingerprint().fingerprint
