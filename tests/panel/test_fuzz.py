"""Requests that nobody at a panel sends: the campaign of `benchmarks.panel_fuzz`, short."""

import asyncio

import pytest

from benchmarks.panel_fuzz import Place, fuzz


@pytest.mark.slow
def test_requests_drawn_at_random_change_nothing_without_the_right_to(tmp_path):
    outcome = asyncio.run(fuzz(Place(tmp_path), 300, seed=7))
    assert outcome.wrong == []
    assert outcome.requests == 300
    assert outcome.entitled > 5
    assert {200, 303, 401, 403, 404, 405, 413} <= outcome.statuses.keys()
