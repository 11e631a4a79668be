"""The section `check_block` of a bench file: what it may say, and what is refused."""

from pathlib import Path

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench


def load(tmp_path: Path, section: str):
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    file = tmp_path / "bench.yaml"
    file.write_text(f"{text}\ncheck_block:\n{section}\n", encoding="utf-8")
    return load_bench(file).check_block


def test_a_section_is_read_in_si(tmp_path):
    section = load(
        tmp_path,
        "  serial: CHECK-1\n  rule: refuse\n  max_age: 12 h\n  k: 3\n  between_runs: [temperature]\n"
        "  drift:\n    Kxx: {per_year: 30 uV/g, u: 10 uV/g}\n    U0x: {per_year: -50 uV, u: 5 uV}\n",
    )
    assert (section.rule, section.max_age, section.k, section.baseline) == ("refuse", 43200.0, 3.0, 10)
    assert section.drift["Kxx"].value("Kxx") == pytest.approx((3e-5, 1e-5))
    assert section.drift["U0x"].value("U0x") == pytest.approx((-5e-5, 5e-6))
    assert section.is_of("a block", "CHECK-1", "a block")
    assert not section.is_of("a block", "17", "a block")
    assert not section.is_of("another", "CHECK-1", "a block")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("rule: stop", "refuse"),
        ("max_age: 12", "duration"),
        ("arl: 5", "20"),
        ("k: 3\n  arl: 370", "'arl' and 'k' state the same limit"),
        ("smoothing: 0", "0.03"),
        ("limits: guessed", "stated"),
        ("between_runs: [voltmeter_gain]", "mounting_roll"),
        ("drift: {Kxw: {per_year: 1 uV/g, u: 1 uV/g}}", "Kxw is not a coefficient"),
        ("drift: {Kxx: {per_year: 1 uV, u: 1 uV/g}}", "scale factor"),
        (
            "drift: {Kxx: {per_year: 1 uV/g, u: -1 uV/g}}",
            "the standard uncertainty is negative; state 0 or more",
        ),
        ("reference: [a]\n  baseline_days: {first: 2026-01-01, last: 2026-01-02}", "remove one"),
    ],
)
def test_what_it_cannot_say_is_told(tmp_path, line, told):
    with pytest.raises(FileMistakes, match=told):
        load(tmp_path, f"  serial: CHECK-1\n  {line}")
