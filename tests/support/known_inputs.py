"""Records at a known input: published ones, and twins simulated without `bench/model`."""

from pathlib import Path
from typing import Any

import numpy as np

from bench.config.foreign_log import LogColumns, convert_log
from bench.readings.csv import read_csv
from bench.readings.table import Readings

DATA = Path(__file__).parents[1] / "data/known-input"
BATH = DATA / "meter-in-air-bath-1v.csv"
SWEPT = DATA / "reference-supply-swept.csv"

BATH_COLUMNS = {
    "time_s": "time_s", "reference_v": ["k1_v", "k2_v", "k3_v"], "ux_v": "dut1_v", "uy_v": "dut2_v",
    "meter_temperature_c": "dut_temperature_c",
}  # fmt: skip
SWEPT_COLUMNS = {
    "time_s": "time_s", "ux_v": {"columns": "difference_uv", "unit": "uV"}, "rail_supply_v": "supply_v",
    "room_c": "room_c",
}  # fmt: skip


def as_readings(log: Path, columns: dict[str, Any], folder: Path, **constants: str) -> Readings:
    """Return the readings of a log with these columns, by way of a readings file in `folder`."""
    mapping = LogColumns.model_validate(
        {"log_columns": "1", "columns": columns, "constants": {"installation": "R", **constants}}
    )
    file = folder / f"{log.stem}.csv"
    file.write_text(convert_log(log, log.read_bytes(), mapping).text, encoding="utf-8")
    return read_csv(file, ())


def switched_on(folder: Path, seed: int, settles_v: float, tau_min: float) -> Path:
    """Write a record of 10 h at 1 V after switch-on: a settling zero, a random walk, white noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 10 * 3600.0, 30.0)
    walk = np.cumsum(rng.normal(0.0, 0.05e-6, len(time_s)))
    volts = 1.0 + settles_v * np.exp(-time_s / (60.0 * tau_min)) + walk + rng.normal(0.0, 0.5e-6, len(time_s))
    file = folder / f"switched-on-{seed}.csv"
    rows = (f"R,{t:g},1,{u:.9f}" for t, u in zip(time_s, volts, strict=True))
    file.write_text("\n".join(["installation,time_s,reference_v,ux_v", *rows]) + "\n")
    return file


def twin(
    folder: Path,
    seed: int,
    gain_per_k: float = 0.74e-6,
    lag_min: float = 95.0,
    jump_v: float = 0.0,
    colder_k: float = 0.0,
) -> Path:
    """Write a 38 h record at 1 V like the air bath's: gain with a thermal lag, random walk, white noise.

    At its start the meter is colder than the bath by `colder_k`.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 38 * 3600.0, 60.0)
    hours, bath = [0, 3, 10, 13, 20, 26, 34, 37, 38], [24, 24, 36.7, 36.7, 24, 24, 18.6, 18.6, 20]
    bath_c = np.interp(time_s / 3600.0, hours, bath)
    inside_c = bath_c.copy()
    inside_c[0] -= colder_k
    for i in range(1, len(time_s)):
        inside_c[i] = inside_c[i - 1] + (bath_c[i] - inside_c[i - 1]) * -np.expm1(-60.0 / (60.0 * lag_min))
    walk = np.cumsum(rng.normal(0.0, 0.012e-6, len(time_s)))
    volts = 1.0 + 23e-6 + gain_per_k * (inside_c - 23.0) + walk + rng.normal(0.0, 0.1e-6, len(time_s))
    volts += jump_v * (time_s > 22.3 * 3600.0)
    file = folder / f"twin-{seed}.csv"
    rows = (f"R,{t:g},1,{u:.9f},{c:.3f}" for t, u, c in zip(time_s, volts, bath_c, strict=True))
    file.write_text("\n".join(["installation,time_s,reference_v,ux_v,meter_temperature_c", *rows]) + "\n")
    return file


GAIN, OFFSET = 1.0 + 12e-6, 3e-6
"""Gain and offset (V) of the meter in `record_at_levels`."""


def record_at_levels(
    folder: Path,
    seed: int,
    *,
    levels: tuple[float, ...] = (0.0, 10.0),
    walk: float = 0.0,
    sd: str = "",
    per_k: float = 0.0,
    count: int = 240,
) -> Readings:
    """Return a record of 40 h through `levels`; `walk` is the step of a random walk a reading, V."""
    rng = np.random.default_rng(seed)
    time_s = np.linspace(0.0, 40 * 3600.0, count)
    reference = np.array(levels)[np.arange(count) // 6 % len(levels)]
    warmth = 5.0 * np.sin(2.0 * np.pi * np.arange(count) / 80.0)
    volts = GAIN * reference + OFFSET + per_k * warmth + rng.normal(0.0, 0.2e-6, count)
    volts += np.cumsum(rng.normal(0.0, walk, count)) if walk else 0.0
    rows = [
        f"R,{t:.3f},{r:.6f},{sd},{v:.10f},{23.0 + w:.4f}"
        for t, r, v, w in zip(time_s, reference, volts, warmth, strict=True)
    ]
    file = folder / f"record-{seed}.csv"
    header = "installation,time_s,reference_v,reference_sd_v,ux_v,meter_temperature_c"
    file.write_text("\n".join([header, *rows]) + "\n")
    return read_csv(file, ())
