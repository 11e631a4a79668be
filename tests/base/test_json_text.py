"""JSON read by the faster parser is what the standard library reads."""

import json

import numpy as np
import pytest

from bench.base.files import read_json


def test_numbers_are_the_same_to_the_last_bit():
    """Any bit pattern that is a finite number, seed 5, and numbers that are hard to round."""
    patterns = np.random.default_rng(5).integers(0, 2**63, 20_000, dtype=np.uint64).view(np.float64)
    hard = [5e-324, 2.2250738585072011e-308, 9007199254740993.0, -0.0, 1.7976931348623157e308, 0.1]
    numbers = [*patterns[np.isfinite(patterns)].tolist(), *hard]
    found = read_json(json.dumps(numbers).encode())
    assert np.array(found).tobytes() == np.array(numbers).tobytes()


@pytest.mark.parametrize(
    "text",
    ['"\\ud800"', '{"a": 1, "a": 2}', "123456789012345678901234567890", "-0", "1e400", '"\\u0000"', " [1]\n"],
)
def test_what_the_standard_library_takes_is_taken(text):
    assert read_json(text.encode()) == json.loads(text)


@pytest.mark.parametrize(
    "content",
    [b"NaN", b"[Infinity]", b"{", b"", b'"\xff"', b"\xef\xbb\xbf1", b"[1,]", b"'a'", b"01", b'"\t"'],
)
def test_what_is_no_json_is_refused(content):
    with pytest.raises(ValueError):  # noqa: PT011 - every kind of it is one
        read_json(content)
