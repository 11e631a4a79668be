"""Test diagnoses of a voltmeter's self-heating, on simulated records with known truth.

    python -m benchmarks.self_heating --records 60 --seed 1

A cold record settles by 20 uV with a time constant of 15 to 90 min, uniform in its logarithm; a warm record
does not settle. The noise is that of tests/support/known_inputs.py, not of the model. The campaign prints the
shares of cold records whose only name is `voltmeter_warm_up`, and of warm records without a name (promised:
at least 0.95 each); and the rms of z = (estimate - truth)/u of size and time constant (promised: within the
99 % interval of an honest u). The exit status is 1 if a promise is broken.
"""

import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from scipy import stats

from bench.diagnosis.record_diagnosis import diagnose_record
from bench.readings.csv import read_csv
from benchmarks.campaign import Share, arguments, finish, rms, spread
from tests.support.known_inputs import switched_on

SIZE_UV: Final = 20.0
TAU_MIN: Final = (15.0, 90.0)
LEAST: Final = 0.95
"""Least share of cold records with the right name alone, and of warm records without a name."""


def cold(seed: int, number: int) -> list[float] | None:
    """Return z of size and time constant of a cold record; None unless its only name is the right one."""
    rng = np.random.default_rng([seed, number])
    tau_min = float(np.exp(rng.uniform(*np.log(TAU_MIN))))
    with tempfile.TemporaryDirectory() as folder:
        file = switched_on(Path(folder), int(rng.integers(2**32)), 1e-6 * SIZE_UV, tau_min)
        found = diagnose_record(read_csv(file, ()))
    if found.verdict != "named" or [one.name for one in found.effects] != ["voltmeter_warm_up"]:
        return None
    pairs = zip(found.effects[0].parameters, (SIZE_UV, tau_min), strict=True)
    return [(one.value - true) / one.u for one, true in pairs if one.u]


def warm(seed: int, number: int) -> bool:
    """Return whether a record without self-heating gets no name."""
    with tempfile.TemporaryDirectory() as folder:
        drawn = int(np.random.default_rng([seed, number, 1]).integers(2**32))
        return not diagnose_record(read_csv(switched_on(Path(folder), drawn, 0.0, 30.0), ())).effects


def main(given: Sequence[str] | None = None) -> int:
    asked = arguments(__doc__, given, records=60, seed=1, workers=1)
    numbers = range(asked.records)
    pulls = list(spread(partial(cold, asked.seed), numbers, asked.workers))
    silent = list(spread(partial(warm, asked.seed), numbers, asked.workers))
    z = np.array([one for one in pulls if one])
    shares = {
        "cold, named alone": Share.true(np.array([one is not None for one in pulls])),
        "warm, no name": Share.true(np.array(silent)),
    }
    low, high = np.sqrt(stats.chi2(len(z)).ppf([0.005, 0.995]) / len(z))
    broken = [f"{what}: {share}" for what, share in shares.items() if share.part < LEAST]
    for what, share in shares.items():
        print(f"{what}: {share}")
    for what, of in zip(("size", "time constant"), rms(z), strict=True):
        print(f"rms z of the {what}: {of:.2f} (99 %: {low:.2f} to {high:.2f})")
        broken += [] if low < of < high else [f"rms z of the {what} is {of:.2f}"]
    return finish(broken)


if __name__ == "__main__":
    sys.exit(main())
