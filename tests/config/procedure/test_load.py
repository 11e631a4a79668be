"""The procedure language: what it expands to, and all mistakes at once with their files and lines."""

import pytest

from bench.base.yaml_files import sha256_of_file
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import check, load_procedure
from bench.config.procedure.plan import Ask, Mount, Read, SetTemperature, Turn, Wait
from bench.config.shipped import find_bench, find_procedure
from drivers.person import PromptKind
from tests.support.procedure_texts import reads


def test_a_turn_settles_and_reads_unless_it_says_what_to_do(load):
    plan = load(
        """\
  - installation:
      label: 3
      steps:
        - turn: {angles: [0 deg, 90 deg]}
        - turn:
            angles: [-90 deg]
            first_point: 3
            direction: falling
            steps:
              - prompt: {kind: confirm, text: Centre the bubble, default: yes}
              - read: {samples: 7}
        - turn: {angles: [10 deg], first_point: 4, steps: [{read: }]}
"""
    ).expand()
    assert [(type(s), s.key) for s in plan.steps] == [
        (Mount, "0001/mount/3"),
        (Turn, "0002/turn/3.1.1"),
        (Wait, "0003/wait"),
        (Read, "0004/read/3.1.1"),
        (Turn, "0005/turn/3.1.2"),
        (Wait, "0006/wait"),
        (Read, "0007/read/3.1.2"),
        (Turn, "0008/turn/3.1.3"),
        (Ask, "0009/ask"),
        (Read, "0010/read/3.1.3"),
        (Turn, "0011/turn/3.1.4"),
        (Read, "0012/read/3.1.4"),
    ]
    assert (plan.steps[2].duration_s, plan.steps[2].reason) == (2.0, "settling")
    assert (plan.steps[9].samples, plan.steps[9].nplc, plan.steps[9].direction) == (7, 1.0, -1)
    assert plan.steps[11].samples == 3
    assert plan.steps[8].kind is PromptKind.CONFIRM
    assert plan.steps[8].default == "yes"


def test_nested_repeats_number_the_passes_on(load):
    plan = load(
        """\
  - installation:
      label: 1
      steps:
        - repeat:
            times: 2
            steps:
              - repeat: {directions: [rising, falling], steps: [{turn: {angles: [0 deg, 1 deg]}}]}
"""
    ).expand()
    assert [row[1:] for row in reads(plan)] == [
        (1, 1, 0, 1),
        (1, 2, 1, 1),
        (2, 2, 1, -1),
        (2, 1, 0, -1),
        (3, 1, 0, 1),
        (3, 2, 1, 1),
        (4, 2, 1, -1),
        (4, 1, 0, -1),
    ]


def test_a_second_visit_has_a_series_of_its_own(load, mistakes):
    visit = "  - installation: {label: 1, steps: [{turn: {angles: [0 deg]}}]}\n"
    plan = load(visit * 2).expand()
    assert [(s.key, s.series) for s in plan.steps if isinstance(s, Mount)] == [
        ("0001/mount/1", 1),
        ("0005/mount/1s2", 2),
    ]
    assert plan.steps[-1].key == "0008/read/1s2.1.1"
    told = mistakes(visit + visit.replace("label: 1", "label: 1, series: 1"))
    assert told[0].startswith("5 steps[2].installation.series: installation 1 was visited before")


def test_temperature_is_set_and_soaked(load):
    plan = load("  - temperature: {at: -20 degC, soak: 2 h}\n  - wait: {for: 90 s}\n").expand()
    assert plan.steps[0] == SetTemperature("0001/temperature", -20.0)
    assert (plan.steps[1].duration_s, plan.steps[1].reason) == (7200.0, "soak at -20 °C")
    assert plan.steps[2].describe() == "wait 90 s: waiting"


def test_many_mistakes_are_told_at_once_with_their_lines(mistakes):
    told = mistakes(
        """\
  - read: {samples: 0}
  - turn: {angels: [0 deg]}
  - installation:
      label: S
      steps:
        - turn: {angles: [0 deg, 361 deg, 5]}
        - read: {nplc: ten}
        - installation: {label: 1, steps: []}
  - repeat: {times: 2, directions: [up], steps: [{wait: {for: 1 V}}]}
  - waite: {for: 1 h}
  - wait: {for: 1 h}
    read:
  - prompt: {kind: number, text: Supply, default: "9", minimum: 10}
"""
    )
    expected = [
        "4 steps[1].read.samples: expected 1 or more, got '0'",
        "4 steps[1].read: a read is outside of an installation",
        "5 steps[2].turn.angels: unknown key 'angels'; did you mean 'angles'?",
        "5 steps[2].turn: a turn is outside of an installation",
        "7 steps[3].installation.label: 'S' marks readings without orientation",
        "9 steps[3].installation.steps[1].turn.angles[2]: state an angle within ±360°, not 361°",
        "9 steps[3].installation.steps[1].turn.angles[3]: expected an angle such as '90 arcsec', got '5",
        "10 steps[3].installation.steps[2].read.nplc: expected a number, got 'ten'",
        "10 steps[3].installation.steps[2].read: a read is outside of a turn",
        "11 steps[3].installation.steps[3].installation.steps: expected a list of at least 1, got a list",
        "11 steps[3].installation.steps[3].installation: an installation is inside another",
        "12 steps[4].repeat.directions[1]: expected rising or falling, got 'up'",
        "12 steps[4].repeat.steps[1].wait.for: expected a duration such as '30 s', got '1 V'",
        "13 steps[5].waite: unknown key 'waite'; did you mean 'wait'?",
        "14 steps[6]: state one verb a step from",
        "15 steps[6].read: a read is outside of an installation",
        "16 steps[7].prompt: the default 9 is not between 'minimum' (10) and 'maximum' (inf); correct it",
    ]
    assert len(told) == len(expected), told
    for start in expected:
        assert any(mistake.startswith(start) for mistake in told), (start, told)


@pytest.mark.parametrize("written", ["ten", "9" * 5000, "0x10", "1e400", "[1, 2]", "{a: 1}"])
@pytest.mark.parametrize("key", ["samples", "nplc"])
def test_what_is_no_number_is_told_in_our_words_with_what_was_written(mistakes, key, written):
    (told,) = mistakes(
        f"  - installation: {{label: 1, steps: [{{turn: {{angles: [0 deg], steps: [{{read: {{{key}: "
        f"{written}}}}}]}}}}]}}\n"
    )
    assert "number, got" in told or told.endswith("got '" + "9" * 80 + "…'")
    assert "nput should" not in told
    assert "parse" not in told


def test_reading_a_point_twice_is_a_mistake_told_once(mistakes):
    told = mistakes(
        """\
  - installation:
      label: 1
      steps:
        - turn: {angles: [0 deg, 1 deg]}
        - repeat:
            times: 2
            steps:
              - turn: {angles: [0 deg, 1 deg]}
        - turn: {angles: [0 deg], first_point: 3, steps: [{read: }, {read: }]}
"""
    )
    assert len(told) == 2
    assert told[0].startswith("11 steps[1].installation.steps[2].repeat.steps[1].turn: point 1 of pass 1 in")
    assert told[1].startswith(
        "12 steps[1].installation.steps[3].turn.steps[2].read: point 3 of pass 1 in inst"
    )


def test_an_included_file_stands_where_it_is_included(load, tmp_path):
    part = "steps:\n  - turn: {angles: [0 deg]}\n"
    own = "reading: {samples: 9, nplc: 100, settle: 0 s}\n" + part.replace(
        "[0 deg]", "[1 deg], first_point: 2"
    )
    body = "  - installation: {label: 1, steps: [{include: part.yaml}, {include: own.yaml}]}\n"
    procedure = load(body, part=part, own=own)
    kinds = [type(s) for s in procedure.expand().steps]
    assert kinds == [Mount, Turn, Wait, Read, Turn, Read]
    assert [s.samples for s in procedure.expand().steps if isinstance(s, Read)] == [3, 9]
    assert [path.name for path in procedure.files] == ["p.yaml", "part.yaml", "own.yaml"]
    before = procedure.expand().hash
    changed = load(body, part=part + "# a comment\n", own=own).expand()
    assert changed.procedure_sha256 != procedure.plan.procedure_sha256
    assert changed.hash != before


def test_the_hash_of_a_single_file_is_its_own():
    path = find_procedure("paper")
    assert load_procedure(path).plan.procedure_sha256 == sha256_of_file(path)


def test_mistakes_in_included_files_name_file_and_line(mistakes):
    told = mistakes(
        "  - include: part.yaml\n  - include: missing.yaml\n  - include: broken.yaml\n",
        part="# first line\nsteps:\n  - wait: {for: 1 m}\n  - read:\n",
        broken="steps: [\n",
    )
    assert told[0].startswith("5 steps[2].include: ")
    assert "missing.yaml: there is no such file" in told[0]
    assert told[1].startswith("broken.yaml2 : this is not YAML")
    assert told[2].startswith("part.yaml3 steps[1].wait.for: expected a duration such as '30 s', got '1 m'")
    assert told[3].startswith("part.yaml4 steps[2].read: a read is outside of an installation")
    assert len(told) == 4


def test_files_that_include_each_other_are_refused(mistakes):
    told = mistakes(
        "  - include: a.yaml\n", a="steps: [{include: b.yaml}]\n", b="steps:\n  - include: a.yaml\n"
    )
    assert told == [
        "b.yaml2 steps[1].include: the file includes itself, remove that: a.yaml → b.yaml → a.yaml"
    ]


def test_temperatures_need_a_chamber_that_reaches_them(load, tmp_path):
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    chamber = "  chamber: {driver: manual-chamber, minimum: -60 degC, maximum: 100 degC}\n"
    assert chamber in text
    plan = load("  - temperature: {at: 50 degC}\n").expand()
    path = tmp_path / "b.yaml"
    path.write_text(text.replace(chamber, ""), encoding="utf-8")
    assert check(plan, load_bench(path)) == [
        "step 0001/temperature: the procedure sets temperatures, but the bench file has no chamber; add one"
    ]
    path.write_text(text.replace("maximum: 100 degC", "maximum: 40 degC"), encoding="utf-8")
    assert check(plan, load_bench(path)) == [
        "step 0001/temperature: 50 °C exceeds the limits of the chamber, -60 to 40 °C; change the temperature"
    ]
