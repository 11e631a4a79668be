"""Bench files with an encoder beside a head that a person turns."""

import math

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.devices.registry import devices
from bench.config.shipped import find_bench
from bench.run.assembly.instruments import on_terminals
from tests.support.instrument_stand import written_bench

BENCH = find_bench("bench-encoder")


def section(tmp_path, name, **changes):
    return load_bench(written_bench(devices().get(name), tmp_path, **changes)).instruments.head


def test_the_shipped_bench_is_read_hands_free():
    head = load_bench(BENCH).instruments.head
    assert (head.driver, head.model, head.hands_free, head.typed) == (
        "heidenhain-nd28x", "ND-287", True, False,
    )  # fmt: skip
    assert head.turned_by_hand
    assert not head.by_hand


def test_with_seven_bits_no_pseudo_terminal_stands_for_its_port():
    assert "head" not in on_terminals(load_bench(BENCH))


@pytest.mark.parametrize(
    ("name", "changes", "why"),
    [
        ("heidenhain-nd28x", {"hands_free": "yes", "typed": "yes"}, "typing needs a hand"),
        ("heidenhain-nd28x", {"backoff": "30 arcsec"}, "the back-off is not above the tolerance"),
        ("heidenhain-nd28x", {"settle": "0 s"}, "'settle' is 0 s"),
        ("heidenhain-nd28x", {"rest": "0 arcsec"}, "no encoder stands still"),
        ("heidenhain-nd28x", {"model": "ND-780"}, "ND-281B"),
        ("mitutoyo-mux10", {"channel": 5}, "channel"),
        ("encoder-line", {"pattern": r"POS=([+-]\d+)"}, "expected one named group"),
        ("encoder-line", {"pattern": r"POS=(?P<angle>[+-]\d+"}, "expected a pattern"),
        ("encoder-line", {"example": "POS=45"}, "does not match the example"),
        (
            "encoder-line",
            {"pattern": "(?P<angle>.*)", "example": "POS=45", "errors": {}},
            "correct the pattern: the angle in the example is not a number, but 'POS=45'",
        ),
        ("encoder-line", {"errors": {"POS=+999.99999": "none"}}, r"matches the error 'POS=\+999.99999'"),
        (
            "encoder-line",
            {"unit": "counts"},
            "the unit counts needs 'counts_per_turn', and no other unit takes it",
        ),
        (
            "encoder-line",
            {"counts_per_turn": 4096},
            "the unit counts needs 'counts_per_turn', and no other unit takes it",
        ),
        ("encoder-line", {"request": "POS\r"}, "line ends are stated by"),
    ],
)
def test_what_cannot_be_is_a_mistake_of_the_file(tmp_path, name, changes, why):
    with pytest.raises(FileMistakes, match=why):
        section(tmp_path, name, **changes)


def test_a_line_has_the_ends_and_the_unit_that_are_stated(tmp_path):
    head = section(
        tmp_path,
        "encoder-line",
        request_end="CR",
        reply_end="LF",
        unit="counts",
        counts_per_turn=2**20,
        pattern=r"(?P<angle>-?\d{1,8})",
        example="0",
        errors={"?": "no signal"},
    )
    port = head.port()
    assert (port.write_termination, port.read_termination) == ("\r", "\n")
    assert head.driver_options()["per_turn"] == 2**20
    assert math.isclose(section(tmp_path, "encoder-line", unit="arcsec").per_turn, 1296000.0)
