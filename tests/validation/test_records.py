"""The changes that the validation makes to a record are as small as it says."""

from types import SimpleNamespace

import pytest

from bench.run.events import EVENTS
from bench.validation.records import changed_copy


@pytest.mark.parametrize(
    ("mean", "other"), [("-0.163559", "-0.163550"), ("2.5e-05", "2.6e-05"), ("1.0", "1.1"), ("3", "4")]
)
def test_one_digit_of_one_reading_differs(tmp_path, mean, other):
    folder = tmp_path / "run"
    folder.mkdir()
    line = '{"kind": "reading", "mean": [%s, -0.163559, 1.0]}\n'
    (folder / EVENTS).write_text('{"kind": "begun"}\n' + line % mean + line % mean)
    copy = changed_copy(SimpleNamespace(folder=folder, name="run"))
    assert (copy.folder / EVENTS).read_text() == '{"kind": "begun"}\n' + line % other + line % mean
