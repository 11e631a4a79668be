"""The vocabulary of mistakes: what is said of a wiring is what it does, and its matrix undoes it."""

import numpy as np
import pytest

from bench.readings.mistaken import EXCHANGED, REVERSED, RIGHT, SLIPS_RAD, reflected_rad
from drivers.angles import classic_slip

TRUE = np.array([1.0, 20.0, 300.0])


def shown_by(wiring):
    """What the channels x, y, z show of the true signals, from the sentence alone."""
    says = dict(part.split(" shows ") for part in wiring.shown.split(", "))
    return np.array([TRUE["xyz".index(says[channel])] for channel in "xyz"])


@pytest.mark.parametrize("wiring", [RIGHT, *EXCHANGED])
def test_the_matrix_undoes_what_the_words_say(wiring):
    assert (wiring.matrix @ shown_by(wiring)).tolist() == TRUE.tolist()
    assert wiring.channels == tuple(
        c for c, s, t in zip("xyz", shown_by(wiring), TRUE, strict=True) if s != t
    )


def test_every_exchange_and_every_reversal_is_there_once():
    assert len({wiring.order for wiring in EXCHANGED}) == 5
    assert [wiring.channels for wiring in REVERSED] == [("x",), ("y",), ("z",)]
    assert [(wiring.matrix @ TRUE).tolist() for wiring in REVERSED] == [
        [-1.0, 20.0, 300.0],
        [1.0, -20.0, 300.0],
        [1.0, 20.0, -300.0],
    ]


@pytest.mark.parametrize("sign", [1, -1])
def test_slips_are_those_at_which_a_person_is_asked_again(sign):
    assert list(SLIPS_RAD) == ["10°", "1°", "10′", "1′"]
    for size, slip in SLIPS_RAD.items():
        words = classic_slip(0.7 + sign * slip, 0.7, 1e-4)
        assert words is not None
        assert words.endswith(f"({size})")


def test_an_angle_counted_backwards_is_off_by_the_shorter_way():
    angle = np.radians([0.0, 10.0, 90.0, 170.0, 315.0, 359.0])
    assert np.degrees(reflected_rad(angle)) == pytest.approx([0.0, -20.0, -180.0, 20.0, 90.0, 2.0])
