"""The short form of the campaign of planted faults (`python -m benchmarks.validation_campaign`): each is named."""

import pytest

from bench.config.shipped import find_bench
from bench.validation.registry import Context
from benchmarks.validation_campaign import found
from benchmarks.validation_faults import FAULTS

SHORT = (
    "a damaged check standard",
    "x and y exchanged in files",
    "covariance of the solver off by 1e-6",
    "wrong g in the bench file",
    "a wrong unit in an export",
    "a two-sided quantile for the guard band",
    "scale of an autopilot not inverted",
)
"""Faults of several families that are found at once."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_a_planted_fault_is_found_with_its_place(name):
    (fault,) = (one for one in FAULTS if one.name == name)
    failed, placed = found(fault, find_bench("paper-stand"))
    assert failed
    assert placed


def test_each_line_of_the_program_that_a_fault_edits_is_there(tmp_path):
    """A fault whose line has changed could not be planted, and nobody would look for it."""
    edits = [fault for fault in FAULTS if fault.kind == "edit"]
    assert len(edits) > 20
    for fault in edits:
        with fault.plant(Context(find_bench("paper-stand"), tmp_path)):
            pass
