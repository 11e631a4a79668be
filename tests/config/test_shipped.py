"""Shipped procedures and bench files: found by name, copied to edit."""

import shutil

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config import shipped
from bench.config.shipped import CONFIG, PROCEDURES, copy_shipped, find_bench, find_procedure, shipped_folder


def test_names_with_and_without_their_ending_are_found():
    assert find_procedure("calibration") == find_procedure("calibration.yaml")
    assert find_bench("paper-stand").name == "paper-stand.yaml"


def test_a_path_wins_over_a_shipped_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "calibration").mkdir()
    assert find_procedure("calibration").parent != tmp_path
    (tmp_path / "quick.yaml").write_text("mine")
    assert find_procedure("quick.yaml").read_text() == "mine"
    assert "procedure: quick" in find_procedure("quick").read_text(encoding="utf-8")


def names_in(kind):
    names = sorted(path.stem for path in shipped_folder(kind).glob("*.yaml"))
    assert len(names) >= 10
    return ", ".join(names)


def test_an_unknown_name_is_told_with_the_nearest_and_the_list():
    with pytest.raises(FileMistakes) as error:
        find_procedure("calibraton")
    assert str(error.value) == (
        "calibraton: there is no such file, and no shipped procedure of that name; did you mean "
        "calibration? "
        f"shipped are: {names_in(PROCEDURES)}"
    )
    listed = f"shipped are: {names_in(CONFIG)}"
    with pytest.raises(FileMistakes, match=listed):
        find_bench("nothing/like/it.yaml")


def test_copies_are_written_once(tmp_path):
    written = copy_shipped(tmp_path)
    assert {path.relative_to(tmp_path).as_posix() for path in written} == {
        *(f"procedures/{path.name}" for path in find_procedure("paper").parent.glob("*.yaml")),
        *(f"config/{path.name}" for path in find_bench("paper-stand").parent.glob("*.yaml")),
        "config/certificate/laboratory.yaml",
        "config/certificate/order.yaml",
    }
    assert written[-1].read_bytes() == find_bench(written[-1].stem).read_bytes()
    edited = tmp_path / "config" / "bench-gpib.yaml"
    edited.write_text("mine")
    (tmp_path / "procedures" / "quick.yaml").unlink()
    assert copy_shipped(tmp_path) == [tmp_path / "procedures" / "quick.yaml"]
    assert edited.read_text() == "mine"


def test_an_installed_program_finds_them_in_its_own_folder(tmp_path, monkeypatch):
    package = tmp_path / "bench"
    for kind in (shipped.PROCEDURES, shipped.CONFIG):
        shutil.copytree(shipped.shipped_folder(kind), package / "shipped_files" / kind)
    monkeypatch.setattr(shipped, "_PACKAGE", package)
    monkeypatch.chdir(tmp_path)
    assert find_procedure("paper") == package / "shipped_files" / "procedures" / "paper.yaml"
    assert find_bench("bench-rs232").is_relative_to(package)


def test_an_edited_copy_in_the_working_folder_wins_over_the_shipped_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not find_procedure("paper").is_relative_to(tmp_path)
    copy_shipped(tmp_path)
    assert find_procedure("paper") == tmp_path / "procedures" / "paper.yaml"
    assert find_bench("paper-stand.yaml") == tmp_path / "config" / "paper-stand.yaml"
