"""The verb `level`: before a mounting, by itself, where it may stand, what it needs of a bench."""

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import check, load_procedure
from bench.config.procedure.plan import Level, Mount, Plan
from bench.config.shipped import find_bench

STEPS = """\
procedure: levelled
steps:
  - installation:
      label: 1
      level: {settings: 2, within: 8 arcsec}
      steps:
        - turn: {angles: [0 deg]}
  - level:
"""


def loaded(tmp_path, text=STEPS):
    path = tmp_path / "levelled.yaml"
    path.write_text(text, encoding="utf-8")
    return load_procedure(path)


def test_the_platform_is_levelled_before_the_mounting_and_read_again(tmp_path):
    plan = loaded(tmp_path).expand()
    first, second, *_, last = plan.steps
    assert isinstance(first, Level)
    assert (first.installation, first.series, first.settings) == ("1", 1, 2)
    assert first.within_rad is not None
    assert isinstance(second, Mount)
    assert last == Level(last.key, "1", 1)
    assert "level the platform to 8″ for installation 1" in first.describe()
    assert Plan.from_json(plan.to_json()) == plan
    assert plan.counts()["level"] == 2


def test_without_it_a_plan_is_the_one_it_was(tmp_path):
    plain = loaded(
        tmp_path,
        STEPS.replace("      level: {settings: 2, within: 8 arcsec}\n", "").replace("  - level:\n", ""),
    )
    assert not any(isinstance(step, Level) for step in plain.plan.steps)
    assert "level" not in plain.plan.to_json()["operator_time"]


@pytest.mark.parametrize(
    ("old", "new", "mistake"),
    [
        ("      level: {settings: 2, within: 8 arcsec}\n", "", "the platform was not levelled before"),
        ("within: 8 arcsec", "within: 0 arcsec", "no platform is exactly level"),
        ("        - turn: {angles: [0 deg]}", "        - turn: {angles: [0 deg], steps: [{level: {}}]}",
         "a level is inside the steps of a turn"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told_with_its_line(tmp_path, old, new, mistake):
    with pytest.raises(FileMistakes, match=mistake):
        loaded(tmp_path, STEPS.replace(old, new))


def test_it_takes_a_level_on_the_bench(tmp_path):
    plan = loaded(tmp_path).expand()
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    assert check(plan, load_bench(find_bench("bench-gpib")))[0].startswith(
        "step 0001/level/1: the procedure levels the platform, but the bench file has no level"
    )
    chamber = "  chamber: {driver: manual-chamber"
    own = tmp_path / "bench.yaml"
    own.write_text(
        text.replace(chamber, f"  level: {{driver: manual-level, division: 5 arcsec}}\n{chamber}"),
        encoding="utf-8",
    )
    assert check(plan, load_bench(own), dry_run=True) == []
