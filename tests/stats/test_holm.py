"""Probabilities of many looks."""

import numpy as np
import pytest

from bench.stats import holm


def test_holm_is_that_of_its_published_example():
    """Four looks at 0.01, 0.04, 0.03, 0.005: adjusted 0.03, 0.06, 0.06, 0.02."""
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
