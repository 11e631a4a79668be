"""The block as a sensor in m/s^2 in files for PX4, ArduPilot and Kalibr, with notes on what each omits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import yaml

from bench.base.arrays import CHANNELS, Floats
from bench.base.languages import message
from bench.calibration.result import NOT_DETERMINED
from bench.exchange.checks import READ_CHECKS, check_lines, judged, own_test, picture
from bench.exchange.result import BlockResult
from bench.history.measured import STANDARD_GRAVITY

DIGITS: Final = 3
"""Significant digits of the calibrated scale factors, which convert signals if no others are requested."""


@dataclass(frozen=True)
class Sensor:
    """The block as a sensor in m/s²: z = M a + b, with the specific force a in m/s².

    z_i = 9.80665 U_i / S_i converts the signals U. The scale factors S are `nominal` (3,), in unit/g.
    """

    nominal: Floats
    M: Floats
    b: Floats
    unit: str

    def signal(self, signal: Floats) -> Floats:
        """Return z (n, 3) in m/s^2 for signals (n, 3)."""
        return np.asarray(STANDARD_GRAVITY * signal / self.nominal)

    def comment_lines(self) -> list[str]:
        """Return comment lines that explain how to compute z from the signals."""
        if self.unit == "m/s^2":
            return ["the signals are in m/s^2 and taken as they are: z = U"]
        factors = ", ".join(f"{float(s)!r}" for s in self.nominal)
        return [
            f"the block gives {self.unit}, this form takes m/s^2: feed it z_i = 9.80665 U_i / S_i with the scale "
            "factors",
            f"S = ({factors}) {self.unit}/g, chosen for it; what the block differs from S is in the values below",
        ]


def sensor_of(result: BlockResult, nominal: Floats | None = None) -> Sensor:
    """Return the block as a sensor in m/s².

    `nominal` (3,) are the scale factors by which signals are converted, in unit per 9.80665 m/s². By default they
    are the calibrated ones, rounded, for signals in counts or V, 1 for g, and 9.80665 for m/s².
    """
    if result.unit == "m/s^2":
        own = np.full(3, STANDARD_GRAVITY)
    elif result.unit == "g":
        own = np.ones(3)
    else:
        found = np.diag(result.block.K) * STANDARD_GRAVITY / result.g_m_s2
        own = np.array([float(f"{value:.{DIGITS}g}") for value in found])
    S = own if nominal is None else nominal
    to_ms2 = STANDARD_GRAVITY / S
    M = result.block.K * (to_ms2 / result.g_m_s2)[:, None]
    return Sensor(S, M, to_ms2 * result.block.U0, result.unit)


def diagonal(sensor: Sensor) -> tuple[Floats, float, float]:
    """Return the scales (3,) for autopilots, and the largest errors (g), at 1 g, of |a| and of the vector a.

    Autopilots use a_i = (z_i - b_i) scale_i, without cross-axis terms: they find a' = D M a, with D = diag(1/M_ii).
    At |a| = 1, |a'| lies between the least and the largest singular value of D M. |a' - a| is at most the largest
    singular value of D M - I. Both bounds are attained.
    """
    scale = 1.0 / np.diag(sensor.M)
    left = scale[:, None] * sensor.M
    size = np.linalg.svd(left, compute_uv=False)
    vector = np.linalg.norm(left - np.eye(3), 2)
    return scale, float(np.max(np.abs(size - 1.0))), float(vector)


def lower_triangular(sensor: Sensor) -> tuple[Floats, Floats, float]:
    """Return M and R of Kalibr's form, `sensor.M` = M R, and the rotation angle (rad) of R.

    M is lower triangular with a positive diagonal. R is the rotation to the axes of M: z = M R a + b.
    """
    q, r = np.linalg.qr(sensor.M.T)
    sign = np.where(np.diag(r) < 0, -1.0, 1.0)
    M, R = (sign[:, None] * r).T, (q * sign).T
    skew = np.linalg.norm(R - R.T) / np.sqrt(8.0)
    return np.tril(M), R, float(np.arctan2(skew, 0.5 * (np.trace(R) - 1.0)))


def axis_rows(values: Floats) -> list[tuple[str, float]]:
    """Return the three `values`, each with its axis: (X, value), (Y, value), (Z, value)."""
    return [(axis.upper(), float(value)) for axis, value in zip(CHANNELS, values, strict=True)]


def _size(error_g: float) -> str:
    """Return an error with its unit in ASCII, for parameter files of autopilots: "12 mg", "35 ug"."""
    from bench.base.numbers import quantity

    return quantity(error_g, "g").replace("µ", "u")


@dataclass(frozen=True)
class Autopilot:
    """The parameters of an autopilot's first accelerometer: names with `{}` for the axis, and allowed ranges.

    `id` and `turn` name the parameters for the sensor's id and for the rotation to the board's axes. `head`
    is the comment at the beginning of a file, `before` that above the values; `row` is the format of a
    value's line. `read` is Python code that reads names and values from such a file. With `sorted_by_name`,
    the parameters are in alphabetical order.
    """

    name: str
    offset: str
    scale: str
    id: str
    turn: str
    offsets: tuple[float, float]
    scales: tuple[float, float]
    row: str
    read: str
    head: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    sorted_by_name: bool = False

    def values(self, sensor: Sensor) -> dict[str, float]:
        """Return the values by parameter name, in the order of the file."""
        rows = [(self.offset.format(axis), value) for axis, value in axis_rows(sensor.b)]
        rows += [(self.scale.format(axis), value) for axis, value in axis_rows(diagonal(sensor)[0])]
        return dict(sorted(rows) if self.sorted_by_name else rows)

    def notes(self, result: BlockResult, nominal: Floats | None = None) -> list[str]:
        """Return comment lines on what the file omits, and on values that the autopilot would reject."""
        sensor = sensor_of(result, nominal)
        scale, modulus_g, vector_g = diagonal(sensor)
        limits = ((self.offset, sensor.b, self.offsets), (self.scale, scale, self.scales))
        return [
            message(
                "the six cross-axis terms are left out, for this form has a scale and an offset per axis and no "
                "more:"
            ),
            message(
                f"at 1 g |a| is off by up to {_size(modulus_g)}, the vector a by up to {_size(vector_g)}, "
                "in the worst direction"
            ),
            *([message(f"the axes of the vector a are {NOT_DETERMINED}")] if result.signs else []),
        ] + [
            message(
                f"{name.format(axis)} = {value:.4g} is outside {low:g} to {high:g}, the limits of {self.name}; "
                "correct more of it in the electronics, or state other scale factors (--nominal)"
            )
            for name, values, (low, high) in limits
            for axis, value in axis_rows(values)
            if not low <= value <= high
        ]

    def text(self, result: BlockResult, nominal: Floats | None = None) -> str:
        """Return the file of parameters, which ground stations load."""
        sensor = sensor_of(result, nominal)
        values = self.values(sensor)
        offset, scale = self.offset.format("i"), self.scale.format("i")
        lines = [
            *self.head,
            *_head(result, sensor, self.notes(result, nominal)),
            *_tested(self, result, sensor, values),
            f"# a = (z - {offset}) * {scale}; {self.name} takes them for the sensor whose id is in {self.id},",
            f"# which this file leaves as it is; its axes are the sensor's, turned to the board's by {self.turn}",
            *self.before,
            *(self.row.format(name=name, value=value) for name, value in values.items()),
        ]
        return "\n".join(lines) + "\n"


PX4: Final = Autopilot(
    "PX4", "CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE", "CAL_ACC0_ID", "SENS_BOARD_ROT",
    offsets=(-math.inf, math.inf),
    scales=(0.1, 3.0),
    row="1\t1\t{name}\t{value:.9g}\t9",  # MAV_PARAM_TYPE_REAL32
    read="{r[2]: float(r[3]) for r in (l.split() for l in open(sys.argv[1]) if l[0] != '#')}",
    head=("# Onboard parameters for Vehicle 1", "#"),
    before=("#", "# Vehicle-Id Component-Id Name Value Type"),
    sorted_by_name=True,
)  # fmt: skip
"""A .params file for the calibration in place 0 of PX4, as QGroundControl loads it."""
ARDUPILOT: Final = Autopilot(
    "ArduPilot", "INS_ACCOFFS_{}", "INS_ACCSCAL_{}", "INS_ACC_ID", "AHRS_ORIENTATION",
    offsets=(-3.5, 3.5),
    scales=(0.8, 1.2),
    row="{name},{value:.9g}",
    read="{k: float(v) for k, v in (l.split(',') for l in open(sys.argv[1]) if l[0] != '#')}",
)  # fmt: skip
"""A .param file for the first accelerometer of ArduPilot, as MAVProxy and Mission Planner load it."""


def _tested(of: Autopilot, result: BlockResult, sensor: Sensor, values: dict[str, float]) -> list[str]:
    """Return comment lines: axes and signs, check vectors (without cross-axis terms), and the file's test."""
    written = {name: float(f"{value:.9g}") for name, value in values.items()}
    off, by = (np.array([written[name.format(axis)] for axis in "XYZ"]) for name in (of.offset, of.scale))
    raw = result.check[0]
    test = (
        f"import sys; n = {of.read}; {READ_CHECKS}; S = {sensor.nominal.tolist()!r}",
        f"def a(u): return [({STANDARD_GRAVITY} * u[k] / S[k] - n['{of.offset}'.format(i)]) * "
        f"n['{of.scale}'.format(i)] for k, i in enumerate('XYZ')]",
        judged(repr(STANDARD_GRAVITY)),
    )
    lines = [
        *picture(result.unit),
        *check_lines(raw, (sensor.signal(raw) - off) * by, "U, then a as this form gives it", "m/s^2"),
        *own_test("FILE", test),
    ]
    return [f"# {line}" for line in lines]


def _head(result: BlockResult, sensor: Sensor, notes: list[str]) -> list[str]:
    lines = [*result.head(), *sensor.comment_lines(), *notes, _expanded(result, sensor, "offsets", "scales")]
    return [f"# {line}" for line in lines]


def _expanded(result: BlockResult, sensor: Sensor, offset: str, scale: str) -> str:
    """Return a line with U of the biases and of the scales, which a file calls `offset` and `scale`."""
    u = np.sqrt(np.diag(result.covariance))
    to_ms2 = [abs(STANDARD_GRAVITY / s) for s in sensor.nominal]
    offsets = ", ".join(f"{result.k * own * size:.2g}" for own, size in zip(u[9:], to_ms2, strict=True))
    parts = result.k * np.hypot(u[[0, 4, 8]] / np.abs(np.diag(result.block.K)), result.gravity_u)
    scales = ", ".join(f"{part:.2g}" for part in parts)
    return f"U of the {offset}: {offsets} m/s^2; of the {scale}: {scales}, relative"


def kalibr_yaml(result: BlockResult, nominal: Floats | None = None) -> str:
    """Return the Kalibr file: `imu0` with its model and M; bias and rotation R follow for other programs."""
    sensor = sensor_of(result, nominal)
    M, R, _ = lower_triangular(sensor)
    raw = result.check[0]
    corrected = np.linalg.solve(M, (sensor.signal(raw) - sensor.b).T).T @ R
    test = (
        "import sys, yaml, numpy as np; d = yaml.safe_load(open(sys.argv[1]))['imu0']['accelerometers']; "
        f"n = {{k: np.array(v) for k, v in d.items()}}; {READ_CHECKS}; S = np.array({sensor.nominal.tolist()!r})",
        f"def a(u): return n['C_accel_block'].T @ np.linalg.solve(n['M'], {STANDARD_GRAVITY} * np.array(u) / S - "
        "n['bias'])",
        judged(repr(STANDARD_GRAVITY)),
    )
    lines = [
        *result.head(),
        *sensor.comment_lines(),
        "z = M C a + b in m/s^2, a the specific force on the block's axes: a = C^T M^-1 (z - b)",
        *kalibr_notes(result, nominal),
        _expanded(result, sensor, "bias", "diagonal of M"),
        "gyroscopes, noise densities, rostopic and update_rate are not known to this bench: add your own",
        *picture(result.unit),
        *check_lines(raw, corrected, "U, then a = C^T M^-1 (z - b)", "m/s^2"),
        *own_test("FILE.yaml", test, " (needs numpy, PyYAML)"),
    ]
    accelerometers = {"M": M.tolist(), "bias": sensor.b.tolist(), "C_accel_block": R.tolist()}
    content = {"imu0": {"model": "scale-misalignment", "accelerometers": accelerometers}}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)
    return "".join(f"# {line}\n" for line in lines) + text


def kalibr_notes(result: BlockResult, nominal: Floats | None = None) -> list[str]:
    """Return comment lines on what Kalibr's file omits."""
    *_, turn_rad = lower_triangular(sensor_of(result, nominal))
    arcsec = math.degrees(turn_rad) * 3600
    if result.signs:
        return [
            message(
                "Kalibr reads M alone, and estimates the bias itself; C_accel_block (the turn to the block's axes) "
                f"is {NOT_DETERMINED}"
            ),
        ]
    return [
        message(
            "Kalibr reads M alone, six of the twelve: it estimates the bias itself, and a comes on other axes,"
        ),
        message(
            f"turned against the block's mounting axes by {arcsec:.4g} arcsec: a vector of 1 g is off by up to "
            f"{2e3 * float(np.sin(turn_rad / 2)):.3g} mg, |a| by nothing."
        ),
        message(
            "bias (m/s^2) and C_accel_block (the turn) are in the file; a reader that uses them loses the "
            "covariance"
        ),
    ]
