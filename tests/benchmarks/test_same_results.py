"""The comparer of two versions' results: what it calls different, and what it does not."""

import json

import pytest

from benchmarks.same_results import Differences, compare, compare_schemas, members


def differences(one, other):
    found = Differences()
    found.values("x", one, other)
    return found.different


@pytest.mark.parametrize(
    ("one", "other", "different"),
    [
        ({"u": 1.0}, {"u": 1.0 + 5e-10}, False),
        ({"u": 1.0}, {"u": 1.0 + 2e-9}, True),
        ({"covariance": [[1.0, 1e-20]]}, {"covariance": [[1.0, -1e-20]]}, False),
        ({"u": 1.0}, {"u": 1.0, "k": 2.0}, True),
        ({"n": 3}, {"n": 3.0}, True),
        ({"passed": True}, {"passed": 1}, True),
        ({"verdict": "pass"}, {"verdict": "fail"}, True),
        ({"created": "2026-11-23T10:00:00Z"}, {"created": "2026-11-24T11:00:00Z"}, False),
        ({"created": "2026-11-23T10:00:00Z"}, {}, True),
        ({"note": "noise of 3.1 uV"}, {"note": "the noise is 3.1 uV"}, False),
        ({"note": "noise of 3.1 uV"}, {"note": "noise of 3.2 uV"}, True),
        ({"p": None}, {"p": 0.5}, True),
        ({"x": "-1.4549221234567"}, {"x": "-1.4549221299999"}, True),
        ({"head": "0f" * 32}, {"head": "1a" * 32}, False),
        ({"told": "head 0f0f0f0f0f0f0f0f"}, {"told": "head 1a1a1a1a1a1a1a1a"}, False),
    ],
)
def test_what_counts_as_a_difference(one, other, different):
    assert bool(differences(one, other)) is different
    assert bool(differences(other, one)) is different


def test_pages_differ_by_their_numbers_and_by_what_is_plotted(tmp_path):
    def stored(name, text, path):
        folder = tmp_path / name / "seed-001"
        folder.mkdir(parents=True)
        (folder / "done").touch()
        (folder / "r.html").write_text(f'<p>{text}</p><svg><path d="M 1 {path}"/></svg>', encoding="utf-8")
        (folder / "r.json").write_text(json.dumps({"u": 1.0}), encoding="utf-8")
        return folder.parent

    first = stored("a", "u = 3.1 uV of noise", 2.0)
    reworded = compare(first, stored("b", "noise u = 3.1 uV", 2.0))
    assert (reworded.different, len(reworded.reworded)) == ([], 1)
    assert compare(first, stored("c", "u = 3.2 uV of noise", 2.0)).different
    assert compare(first, stored("d", "u = 3.1 uV of noise", 2.1)).different


def test_a_file_that_one_store_lacks_is_a_difference_and_so_is_nothing_to_compare(tmp_path):
    one, other = (tmp_path / name / "seed-001" for name in ("a", "b"))
    for folder in (one, other):
        folder.mkdir(parents=True)
        (folder / "done").touch()
    nothing = compare(one.parent, other.parent).different
    assert len(nothing) == 1
    assert "no file that could be compared" in nothing[0]
    (one / "verify.json").write_text("{}", encoding="utf-8")
    assert "seed-001/verify.json: in one store alone" in compare(one.parent, other.parent).different
    (one.parent / "seed-002").mkdir()  # begun and not done: not compared
    (one.parent / "seed-002" / "calibrate.json").write_text("{}", encoding="utf-8")
    assert not any("seed-002" in line for line in compare(one.parent, other.parent).different)


def test_members_of_a_schema_are_told_by_path_through_references_lists_and_maps():
    part = {"type": "object", "properties": {"u": {}, "more": {"$ref": "#/$defs/Part"}}, "required": ["u"]}
    schema = {
        "properties": {"a": {"$ref": "#/$defs/Part"}, "b": {"items": {"anyOf": [{"$ref": "#/$defs/Part"}]}}},
        "additionalProperties": {"properties": {"c": {}}},
        "$defs": {"Part": part},
    }
    found = dict(members(schema, schema["$defs"]))
    paths = {".a", ".a.u", ".a.more", ".b", ".b[].u", ".b[].more", ".{}.c"}
    assert (found.keys(), found[".a.u"], found[".a"]) == (paths, True, False)


def test_a_member_that_this_version_lacks_is_told(tmp_path):
    old = {"properties": {"closed": {}, "lost": {"properties": {"deep": {}}}}, "required": ["closed"]}
    (tmp_path / "confirm.json").write_text(json.dumps(old), encoding="utf-8")
    (tmp_path / "gone.json").write_text("{}", encoding="utf-8")
    lacking = {"confirm: .lost", "confirm: .lost.deep", "gone: the whole schema"}
    assert set(compare_schemas(tmp_path)) == lacking
