"""A pass that was copied is no repeat: each command that evaluates readings says so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.readings.csv import write_csv
from bench.run.folder import Run
from tests.support.commands import printed


@pytest.mark.slow
def test_a_pass_that_equals_another_in_every_digit_is_named(bench, paper_run):
    measured = Run(Path("runs/run")).readings()
    write_csv(measured, Path("own.csv"))
    assert "in every digit" not in printed(bench("calibrate", "own.csv"))
    signal = measured.signal.copy()
    one = measured.installation == "1"
    signal[one & (measured.pass_number == 3)] = signal[one & (measured.pass_number == 2)]
    write_csv(replace(measured, signal=signal), Path("copied.csv"))
    named = "pass 3 of series 1 in installation 1 equals pass 2 of series 1 in every digit"
    for command in ("calibrate", "verify"):
        assert named in " ".join(bench(command, "copied.csv")[1].split())
    # with coarse digits, repeats of one value are no copies
    write_csv(replace(measured, signal=np.round(signal, 3)), Path("coarse.csv"))
    assert "in every digit" not in bench("calibrate", "coarse.csv")[1]
