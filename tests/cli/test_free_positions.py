"""Free positions alone, from the file to what others read: temperature, certificate, verification."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.readings.csv import write_csv
from bench.readings.table import make_readings
from bench.validation.paper_bench import U0, K
from tests.support.commands import printed, refused
from tests.support.honest_runs import free_forces


@pytest.fixture
def free(bench):
    """The file free.csv: 24 positions of the paper's block at 21 °C, noise 100 µV (seed 8)."""
    rng = np.random.default_rng(8)
    signal = free_forces(24, rng) @ K.T + U0 + rng.normal(0, 1e-4, (24, 3))
    table = make_readings(
        ["F"] * 24, [1] * 24, range(1, 25), np.full(24, np.nan), signal, temperature_c=np.full(24, 21.0)
    )
    write_csv(table, Path("free.csv"))
    return Path("free.csv")


def test_their_temperature_is_stated_and_no_certificate_is_made(bench, free):
    printed(bench("import", free, "--name", "free"))
    assert json.loads(printed(bench("calibrate", "free", "--json", "-")))["temperature_c"] == 21.0
    refused(bench("certificate", "free", "--draft"), "free positions alone determine nine")


def test_without_verification_points_verify_says_so(bench, free):
    refused(bench("verify", free), "it has no verification point (installation V)")
    printed(bench("calibrate", free, "--json", "unit.json"))
    refused(bench("verify", free, "--coefficients", "unit.json"), "it has no verification point")
