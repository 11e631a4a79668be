"""The content of every exported file of a calibration: coefficients, numbers derived from them, origin."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from pydantic import Field

from bench.base.arrays import Floats, u_of
from bench.base.languages import message
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.text import one_line
from bench.base.units import parse_quantity
from bench.calibration.intrinsic import intrinsic, intrinsic_unit
from bench.calibration.result import (
    BY_CONVENTION,
    MISALIGNMENTS,
    NOT_DETERMINED,
    Derived,
    inverse,
    misalignments,
)
from bench.config.bench_file.stand import CUBIC, QUADRATIC
from bench.model.geometry import COEFFICIENTS, Block

SIMULATED = message("SIMULATED: found on simulated instruments, of no real block")
CONVENTION = "K_ij = (-1)^n K_ii alpha_ji, n = 2 where j follows i in x -> y -> z -> x, else 1"
NINE = message(
    "S_i = |row i of K|, cos theta_ij = row_i row_j / (S_i S_j), b_i = U0_i / S_i: free of the mounting; b_i has "
    "the sign of the signal: where K_ii < 0, the bias of a is -b_i"
)
COMBINED = message(
    "combined: the stand, the noise of the readings, and every other source that the bench has"
)
OF_READINGS = message(
    "the stand and the noise of these readings alone; gain and offset of the meters are not in it"
)

NOT_ACCEPTED = message(
    "NOT ACCEPTED: the readings contradict the model; find the cause with 'bench diagnose'"
)

OPEN: Final = (
    *BY_CONVENTION,
    *(name.replace("K", "N") for name in BY_CONVENTION),
    *(angle for angle, (cross, _, _) in MISALIGNMENTS.items() if cross in BY_CONVENTION),
)
"""Coefficients, elements of N and angles that are zero by convention if free positions alone gave the result."""


@dataclass(frozen=True)
class ReportedNumber:
    """One number with its standard and its expanded uncertainty, all in `unit`.

    Both uncertainties are NaN for a number that is zero by convention.
    """

    name: str
    value: float
    u: float
    U: float
    unit: str

    @property
    def determined(self) -> bool:
        """Whether the readings determine the number; False if it is zero by convention."""
        return not math.isnan(self.u)


@dataclass(frozen=True)
class ReportedNumbers(Derived):
    """Numbers with their covariance (n, n), and a row for each."""

    rows: tuple[ReportedNumber, ...] = ()

    def part(self, **said: str) -> dict[str, Any]:
        """Return the members of a `DerivedPart`, and the additional members `said`."""
        values = {row.name: row for row in self.rows}
        return {**said, "values": values, "order": self.names, "covariance": self.covariance}


@dataclass(frozen=True)
class FittedEffect:
    """A parameter of an effect of the block, such as K2, which the model of a calibration has beside K and U0."""

    name: str
    value: float
    u: float
    unit: str

    def __str__(self) -> str:
        """Return the name and, if it is known, the value."""
        return f"{self.name} = {self.value:.6g} {self.unit}" if math.isfinite(self.value) else self.name


class FittedEffectPart(ResultModel):
    """A parameter of an effect of the block that a = N (U − U0) leaves out."""

    value: Real
    u: Real = Field(description="standard uncertainty")
    unit: str


class RowPart(ResultModel):
    """A number with its standard and its expanded uncertainty."""

    value: float
    u: Real = Field(description="standard uncertainty; null for a number by convention, not determined")
    U: Real = Field(description="expanded uncertainty; null as u")
    unit: str


class DerivedPart(ResultModel):
    """Numbers computed from the coefficients, with their joint covariance."""

    values: dict[str, RowPart]
    order: list[str]
    covariance: Matrix = Field(description="in `order`")


class InversePart(DerivedPart):
    """N = K⁻¹ in g per unit, and U0: the twelve numbers of a = N (U − U0)."""

    model: str


class MisalignmentsPart(DerivedPart):
    """The angles α_ji (rad) of the input axes."""

    convention: str


class IntrinsicNumbersPart(DerivedPart):
    """The nine intrinsic numbers, which do not depend on the mounting."""

    definition: str


class CheckPart(ResultModel):
    """Check vectors (signals, and the accelerations that must result), and the file's test that uses them."""

    signs: list[str] = Field(description="a picture of axes, signs, order and units")
    tolerance: float = Field(description="largest difference from `corrected`, g")
    raw: Matrix = Field(description="signals at 20 positions")
    corrected: Matrix = Field(description="N (U − U0), g")
    python: list[str] = Field(description="three lines of Python that test the file named as their argument")


class BlockPart(ResultModel):
    """The type and serial number of the block, if they are stated."""

    type: str
    serial: str


class SizePart(ResultModel):
    """The size of an error."""

    u: float
    unit: str


class CoefficientsResult(ResultModel):
    """The data of a calibration for a navigation computer; for several sources, a list of these."""

    source: str = Field(description="the run, readings file or result")
    unit_under_test: BlockPart | None
    made_at: str | None = Field(description="when the run was begun, ISO 8601")
    temperature_c: Real = Field(
        description="temperature of the block at which the coefficients hold, °C: the mean of the readings or, for "
        "those corrected for temperature, the reference; null if unknown"
    )
    bench: dict[str, str] | None = Field(description="the bench file, as in the result of `bench calibrate`")
    certificates: list[str] = Field(description="the certificates of the instruments, in words")
    simulated: bool
    unit: str = Field(description="unit of the signals")
    g_m_s2: float = Field(description="local gravity, m/s²: the g of all other members")
    gravity_u: float = Field(
        description="relative standard uncertainty of `g_m_s2`, not included in numbers per g; 0 if the "
        "result does not state it"
    )
    k: float = Field(description="coverage factor of U")
    combined: bool = Field(
        description="whether u includes every error source of the bench, or only the stand and the noise of these "
        "readings"
    )
    coefficients: dict[str, RowPart] = Field(description="the twelve coefficients of U = K a + U0")
    order: list[str]
    covariance: Matrix = Field(description="covariance of the coefficients, in `order`")
    covariance_readings: Matrix | None = Field(
        description="covariance from the readings; null if the result does not state it separately"
    )
    inverse: InversePart
    misalignments: MisalignmentsPart
    intrinsic: IntrinsicNumbersPart
    convention: str | None = Field(
        default=None, description="what free positions alone do not determine; absent for other readings"
    )
    temperature: str | None = Field(
        description="effects of temperature that these numbers omit by request; null for none"
    )
    fits: bool = Field(default=True, description="false if the readings contradict the model")
    effects: dict[str, FittedEffectPart] = Field(
        default={},
        description="parameters of the block's effects in the model, which these numbers leave out",
    )
    nonlinearity: dict[str, SizePart] = Field(
        default={},
        description="u of K2 and K3 of each axis, which adds to u above 1 g; empty if the result states none",
    )
    notes: list[str] = Field(default=[], description="remarks of the calibration for the reader")
    valid: str = Field(
        default="",
        description="the accelerations and the temperature for which u and the covariances hold, a sentence",
    )
    check: CheckPart


_JSON_TEST: Final = (
    "import json, sys; d = json.load(open(sys.argv[1])); v = d['inverse']['values']; "
    "n = {k: v[k]['value'] for k in v}; "
    "c = [u + v for u, v in zip(d['check']['raw'], d['check']['corrected'])]",
    "def a(u): return [sum(n['N' + i + j] * (u[k] - n['U0' + j]) for k, j in enumerate('xyz')) for i in 'xyz']",
)


@dataclass(frozen=True)
class BlockResult:
    """The coefficients of one block: U = K a + U0, with a in local g of `g_m_s2` (m/s²) and U in `unit`.

    `covariance` (12, 12) is in the order of `COEFFICIENTS`; `covariance_readings` is the part from the readings,
    None if the result does not state it separately. `expanded` maps names of numbers to the U that the result
    states for them; for all other numbers U is `k` times u. `gravity_u` is the relative standard uncertainty of
    `g_m_s2`, 0 if the result does not state it; the u of numbers per g does not include it. `bench` describes the
    bench file of the result, `certificates` those of the instruments. `block_type`, `serial` and `made_at` are
    empty if unknown. `temperature` names the temperature effects for which the result was corrected, and which
    these numbers omit; empty for none. `temperature_c` is the temperature at which the coefficients hold, °C; NaN
    if it is unknown. `fits` is false if the readings contradict the model; `notes` are its remarks; `effects` are
    the parameters of the block's effects in that model, such as K2, which these numbers omit, too. `nonlinearity`
    has u of the block's K2 and K3 in words, `temperature_u` that of its temperature; both are empty if the result
    does not state them. If free positions alone gave the result, `signs` states the source of the scale factors'
    signs, "bench file" or "positive" by convention; otherwise it is empty.
    """

    block: Block
    covariance: Floats
    unit: str
    g_m_s2: float
    source: str
    block_type: str = ""
    serial: str = ""
    made_at: str = ""
    bench: Mapping[str, str] | None = None
    simulated: bool = False
    k: float = 2.0
    expanded: Mapping[str, float] | None = None
    covariance_readings: Floats | None = None
    gravity_u: float = 0.0
    certificates: tuple[str, ...] = ()
    temperature: str = ""
    temperature_c: float = math.nan
    signs: str = ""
    fits: bool = True
    effects: tuple[FittedEffect, ...] = ()
    nonlinearity: tuple[str, ...] = ()
    temperature_u: str = ""
    notes: tuple[str, ...] = ()

    @cached_property
    def check(self) -> tuple[Floats, Floats]:
        """The check vectors: signals at `checks.POSITIONS` and N (U - U0) in g, (20, 3) each."""
        from bench.exchange.checks import POSITIONS

        raw, numbers = self.block.output(POSITIONS), self.inverse.values
        return raw, np.asarray((raw - numbers[9:]) @ numbers[:9].reshape(3, 3).T)

    @cached_property
    def combined(self) -> bool:
        """Whether u includes every error source of the bench, and not only the part from the readings.

        False if the result does not state that part separately.
        """
        readings = self.covariance_readings
        return readings is not None and not np.array_equal(readings, self.covariance)

    @cached_property
    def coefficients(self) -> ReportedNumbers:
        """The twelve coefficients."""
        own = Derived(COEFFICIENTS, self.block.vector, self.covariance)
        return self._reported(own, lambda name: self.unit if name.startswith("U0") else f"{self.unit}/g")

    @cached_property
    def inverse(self) -> ReportedNumbers:
        """N and U0 of a = N (U - U0)."""
        unit = "g/(m/s^2)" if self.unit == "m/s^2" else f"g/{self.unit}"
        numbers = inverse(self.block, self.covariance)
        return self._reported(numbers, lambda n: self.unit if n.startswith("U0") else unit)

    @cached_property
    def misalignments(self) -> ReportedNumbers:
        """The six angles (rad) of the input axes."""
        return self._reported(misalignments(self.block, self.covariance), lambda _: "rad")

    @cached_property
    def intrinsic(self) -> ReportedNumbers:
        """The nine intrinsic numbers, which do not depend on the mounting."""
        numbers = intrinsic(self.block, self.covariance)
        return self._reported(numbers, lambda name: intrinsic_unit(name, self.unit))

    def _reported(self, of: Derived, unit_of: Callable[[str], str]) -> ReportedNumbers:
        stated = self.expanded or {}
        sizes = zip(of.names, of.values.tolist(), u_of(of.covariance).tolist(), strict=True)
        rows = [
            ReportedNumber(n, value, math.nan, math.nan, unit_of(n))
            if self.signs and n in OPEN
            else ReportedNumber(n, value, u, stated.get(n, self.k * u), unit_of(n))
            for n, value, u in sizes
        ]
        return ReportedNumbers(of.names, of.values, of.covariance, of.jacobian, tuple(rows))

    @property
    def block_name(self) -> str:
        """Type and serial number of the block."""
        return f"{self.block_type} {self.serial}".strip()

    def facts(self) -> dict[str, str]:
        """Return the facts of the header by name, in the order of display; each is a text of one line."""
        u_m_s2 = self.g_m_s2 * self.gravity_u
        of_g = message(f" (u = {u_m_s2:.2g} m/s^2, which is in no number per g)") if self.gravity_u else ""
        told = {
            **({"mark": SIMULATED} if self.simulated else {}),
            **({} if self.fits else {"fit": NOT_ACCEPTED}),
            "block": self.block_name or message("not stated"),
            "source": self.source,
            "made at": self.made_at or "not stated",
            "block temperature": f"{self.temperature_c:.1f} deg C"
            if math.isfinite(self.temperature_c)
            else "not stated",
            "bench": (self.bench or {}).get("name", "not stated"),
            "certificates": "; ".join(self.certificates) or message("none of the instruments is stated"),
            "local gravity": message(f"g = {self.g_m_s2!r} m/s^2{of_g}: accelerations are in this g"),
            "uncertainty": message(
                f"u: standard uncertainty, U = k u with k = {self.k:g}; "
                f"{COMBINED if self.combined else OF_READINGS}"
            ),
            "range": self._range,
        }
        if self.signs:
            told["convention"] = self._convention
        if self.temperature:
            told["temperature"] = message(f"WITHOUT TEMPERATURE, as asked: {self.temperature}")
        if self.effects:
            listed = ", ".join(map(str, self.effects))
            told["left out"] = message(
                f"a = N (U - U0) leaves out what the model has beside K and U0: {listed}"
            )
        told |= {f"note {number}": note for number, note in enumerate(self.notes, 1)}
        return {name: one_line(text) for name, text in told.items()}

    @property
    def _nonlinearity(self) -> dict[str, SizePart]:
        """u of K2 and K3 as numbers; empty if a size is unknown."""
        kinds = {"K2": QUADRATIC, "K3": CUBIC}
        if len(self.nonlinearity) < len(kinds):
            return {}
        try:
            return {
                name: SizePart(u=float(f"{parse_quantity(size, kind):.12g}"), unit=kind.si)
                for (name, kind), size in zip(kinds.items(), self.nonlinearity, strict=True)
            }
        except ValueError:
            return {}

    @property
    def _range(self) -> str:
        """A sentence on the accelerations and the temperature for which u and the covariances hold."""
        terms = " and ".join(
            f"{size} a^{power}".strip() for power, size in enumerate(self.nonlinearity or ("K2", "K3"), 2)
        )
        within = message(f", which has u = {self.temperature_u}") if self.temperature_u else ""
        return message(
            f"u and covariance of a hold up to 1 g; above, add the block's nonlinearity, {terms} of each axis "
            f"(k = 1), by 'bench budget'; they hold at the block temperature stated here{within}"
        )

    @property
    def _convention(self) -> str:
        """A sentence on what free positions alone do not determine."""
        signs = "those of the bench file" if self.signs == "bench file" else "positive"
        return message(
            f"{', '.join(OPEN)}: {NOT_DETERMINED}, as free positions alone show no orientation; the signs of the "
            f"scale factors, which no position shows either, are {signs}; covariances hold for this convention"
        )

    def head(self) -> list[str]:
        """Return the header facts as lines."""
        return [f"{name}: {text}" if name != "mark" else text for name, text in self.facts().items()]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `bench coefficients --json`."""
        from bench.exchange.checks import TOLERANCE, judged, picture

        return CoefficientsResult.from_object(
            self,
            unit_under_test={"type": self.block_type, "serial": self.serial} if self.block_name else None,
            made_at=self.made_at or None,
            bench=self.bench or None,
            coefficients={row.name: row for row in self.coefficients.rows},
            order=list(COEFFICIENTS),
            inverse=self.inverse.part(model="a = N (U - U0), a in g"),
            misalignments=self.misalignments.part(convention=CONVENTION),
            temperature=self.facts().get("temperature"),
            effects={one.name: one for one in self.effects},
            nonlinearity=self._nonlinearity,
            valid=self._range,
            **({"convention": self._convention} if self.signs else {}),
            check=CheckPart(
                signs=picture(self.unit),
                tolerance=TOLERANCE,
                raw=self.check[0],
                corrected=self.check[1],
                python=[*_JSON_TEST, judged()],
            ),
            intrinsic=self.intrinsic.part(definition=NINE),
        ).to_dict()
