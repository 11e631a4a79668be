"""The report on the house: what it says of circles and of who imports whom."""

from pathlib import Path

import pytest

from benchmarks.house import ROOT, Module, circles, modules, room_of


def module(name, text):
    return Module(name, ROOT / "bench" / "room" / f"{name}.py", text)


def test_circles_are_components_with_more_than_one_module():
    edges = {"a": ["b"], "b": ["c"], "c": ["a", "d"], "d": [], "e": ["f"], "f": ["e"], "g": ["a"]}
    assert circles(edges) == [["a", "b", "c"], ["e", "f"]]


def test_an_import_inside_a_function_is_told_apart_from_one_of_the_module():
    known = {name: module(name, "") for name in ("b", "c", "d")}
    text = "from b import x\nif TYPE_CHECKING:\n    import c\n\ndef f():\n    from d import y\n"
    known["a"] = module("a", text)
    assert sorted(known["a"].imported(known, inner=False)) == ["b", "c"]
    assert sorted(known["a"].imported(known, inner=True)) == ["b", "c", "d"]


@pytest.mark.slow
def test_the_program_is_found_whole():
    known = modules()
    assert {"bench", "bench.base.arrays", "drivers.clock", "sim.world"} <= set(known)
    assert known["bench.base.arrays"].room == "base"
    of_base = [one for one in known.values() if one.room in {"base", "readings"}]
    assert all(other in known for one in of_base for other in one.imported(known, inner=True))


def test_a_file_stands_in_a_folder_of_bench_or_in_a_whole_top_folder():
    files = (
        "bench/run/assembly/hands.py",
        "bench/__init__.py",
        "sim/world/clock.py",
        "tests/run/test_live.py",
    )
    assert [room_of(Path(file)) for file in files] == ["run", "bench", "sim", "tests"]
