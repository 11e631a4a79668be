"""What a certificate says, typed: all that ISO/IEC 17025:2017, 7.8 asks for, before it is paper or XML.

Nothing here depends on the day on which it is looked at, on the folder or on who looks: the same record, the same
files and the same `Issue` give the same certificate, and both forms of it the same bytes.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, TypeVar

from bench.base.arrays import Floats, u_of
from bench.calibration import Verification
from bench.calibration.conformity import (
    FALSE_ACCEPTANCE,
    GUARDED,
    NON_BINARY,
    SIMPLE,
    DecisionRule,
    Statement,
)
from bench.calibration.verification import by_rule
from bench.certificate.laboratory import (
    Laboratory,
    Order,
    Person,
    StatedField,
    Texts,
    UnitOrder,
    stated_fields,
)  # fmt: skip
from bench.config.devices.device import Certificate as Held
from bench.services.calibration import CalibrationResult
from bench.services.verification import VerificationResult

FORMULA: Final = "U = K a + U0, a = N (U - U0), N = K^-1, delta_g = |a| - 1"
"""The model as text: U (3) the signals, a (3) the specific force in local g, +1 on an axis that points up."""

Said = TypeVar("Said")
_RULES: Final = {SIMPLE: "rule_simple", GUARDED: "rule_guarded", NON_BINARY: "rule_non_binary"}


@dataclass(frozen=True)
class Value:
    """A result in `unit` with its standard uncertainty u, U = k u and the degrees of freedom of u."""

    name: str
    value: float
    u: float
    U: float
    k: float
    dof: float
    unit: str


@dataclass(frozen=True)
class Values:
    """Results that belong together, with their covariance (n, n) in the order of `values`."""

    values: tuple[Value, ...]
    covariance: Floats

    @classmethod
    def of(
        cls, named: Mapping[str, str], values: Floats, covariance: Floats, k: float, dof: Floats
    ) -> Values:
        """Return the results whose names and units are `named`, with degrees of freedom `dof` (n,)."""
        sizes = zip(values.tolist(), u_of(covariance).tolist(), strict=True)
        rows = zip(named.items(), sizes, dof.tolist(), strict=True)
        found = (Value(name, value, u, k * u, k, nu, unit) for (name, unit), (value, u), nu in rows)
        return cls(tuple(found), covariance)

    def __getitem__(self, name: str) -> Value:
        return next(value for value in self.values if value.name == name)


@dataclass(frozen=True)
class Condition:
    """A condition during the run: a quantity that lay between `low` and `high`, in `unit`.

    `key` names its text in the certificate; `about` fills the blank in that text (the supply rail). `u` is its
    standard uncertainty, None where only the range is known.
    """

    key: str
    low: float
    high: float
    unit: str
    about: str = ""
    u: float | None = None
    source: str = ""


@dataclass(frozen=True)
class Instrument:
    """An instrument that was used: what it answered, and its certificate as it stood on the day of the run.

    `why_not` says why nothing was corrected by the certificate; `foreign` that it is of another instrument.
    """

    name: str
    role: str
    identity: str
    serial: str
    certificate: Held | None = None
    expired: bool = False
    foreign: bool = False
    correction: str = ""
    why_not: str = ""


@dataclass(frozen=True)
class Contribution:
    """What u holds that the readings do not show: `u` is the largest part it adds, in that of `most_in`."""

    name: str
    size: str
    origin: str
    prior: bool
    u: float
    most_in: str
    unit: str


@dataclass(frozen=True)
class Item:
    """The unit that was calibrated, as the record names it."""

    type: str
    serial: str


@dataclass(frozen=True)
class Method:
    """How it was calibrated: procedure and hash of its plan (empty of imported readings), estimator, model."""

    procedure: str
    plan_hash: str
    estimator: str
    model: str


@dataclass(frozen=True)
class RunReference:
    """The run by which the results can be known again; `seal` is the text of its seal (JSON).

    `sealed` is when it was sealed, empty for a run that was not: `seal` then says what a seal would have said.
    """

    run: str
    events: int
    head: str
    manifest_sha256: str
    seal: str
    sealed: str


@dataclass(frozen=True)
class RunFindings:
    """What a run shows of the unit. `begun` and `ended` are civil times (ISO 8601), empty where nobody knows.

    `result` and `verdict` are the whole evaluation, `result_json` and `readings_csv` the files that say it;
    `verdict` is None where no verification point was measured.
    """

    record: RunReference
    item: Item
    begun: str
    ended: str
    operator: str
    method: Method
    coefficients: Values
    inverse: Values
    misalignments: Values
    conditions: tuple[Condition, ...]
    instruments: tuple[Instrument, ...]
    contributions: tuple[Contribution, ...]
    result: CalibrationResult
    verdict: VerificationResult | None
    result_json: str
    readings_csv: str
    notes: tuple[str, ...]
    simulated: bool

    @property
    def verification(self) -> Verification | None:
        """The check at the verification points, None where none was measured."""
        return None if self.verdict is None else self.verdict.verification


@dataclass(frozen=True)
class Before:
    """The certificate before this one: `kind` is "amended" or "replaced", `sha256` that of its XML as issued."""

    kind: str
    number: str
    issued: str
    reason: str
    sha256: str


@dataclass(frozen=True)
class Issue:
    """What happens once: the number, when it was issued (ISO 8601, to the second), who authorised it.

    `signed_by` is whom the certificate of the key names, empty where nobody signs.
    """

    number: str
    issued: str
    authorised_by: Person
    before: Before | None = None
    signed_by: str = ""

    @property
    def day(self) -> str:
        """The day on which it was issued."""
        return self.issued[:10]


@dataclass(frozen=True)
class Attached:
    """A file that goes with the certificate."""

    name: str
    media_type: str
    description: str
    content: bytes


@dataclass(frozen=True)
class Certificate:
    """A certificate; of a draft `issue`, and where they were not given `laboratory` and `order`, are None.

    `unit` is what the order says of this unit, `as_found` what a run before an adjustment showed. `texts` are the
    words in the languages asked for, the first one first.
    """

    found: RunFindings
    texts: tuple[Texts, ...]
    laboratory: Laboratory | None = None
    order: Order | None = None
    unit: UnitOrder | None = None
    as_found: RunFindings | None = None
    issue: Issue | None = None

    @property
    def draft(self) -> bool:
        """Whether it has no number."""
        return self.issue is None

    @property
    def unsigned(self) -> bool:
        """Whether it has a number and nobody signs it: every page says so."""
        return self.issue is not None and not self.issue.signed_by

    @property
    def simulated(self) -> bool:
        """Whether it is of simulated instruments: every page says so."""
        return self.found.simulated

    @property
    def number(self) -> str:
        """Its number, empty for a draft."""
        return "" if self.issue is None else self.issue.number

    @property
    def k(self) -> float:
        """The coverage factor of the coefficients' U."""
        return self.found.coefficients.values[0].k

    @property
    def coverage(self) -> float:
        """The coverage probability of k for a normal distribution."""
        return math.erf(self.k / math.sqrt(2.0))

    @property
    def place(self) -> str:
        """Where it was calibrated; empty where nobody says it."""
        stated = self.order.place if self.order is not None else None
        return stated or (self.laboratory.place if self.laboratory is not None else "")

    @property
    def calibrated(self) -> tuple[datetime.date, datetime.date] | None:
        """The first and the last day of the calibration; None where nobody says it."""
        first, last = day_of(self.found.begun), day_of(self.found.ended)
        if first is None or last is None:
            first = last = None if self.unit is None else self.unit.calibrated
        return None if first is None or last is None else (first, last)

    @property
    def state(self) -> str:
        """Whether the results show the unit as found or as left; empty where nobody says it."""
        return "" if self.unit is None else self.unit.state

    @property
    def origins(self) -> dict[str, list[tuple[str, dict[str, str]]]]:
        """What is not the laboratory's own: sampling, external providers, the customer's data.

        Keys of texts: a head, and sentences with what fills their blanks. Empty without an order. Source:
        ISO/IEC 17025:2017, 7.8.2.1 k and p, 7.8.2.2.
        """
        order = self.order
        if order is None:
            return {}
        sampling = ("given", {"text": order.sampling}) if order.sampling else ("sampling_none", {})
        external = [("external_text", {"what": one.what, "by": one.by}) for one in order.external]
        supplied = [
            ("supplied_affects" if one.affects_validity else "given", {"text": one.what})
            for one in order.supplied
        ]
        return {
            "sampling": [sampling],
            "external": external or [("none_stated", {})],
            "supplied": [("supplied_order", {}), *supplied],
        }

    @property
    def stated(self) -> tuple[StatedField, ...]:
        """What laboratory and order files state beside what every certificate has."""
        return tuple(stated_fields(self.laboratory, self.unit, self.order))

    @property
    def terms(self) -> tuple[str, ...]:
        """The keys of the statements of the first page."""
        supplied = () if self.order is None else self.order.supplied
        affected = ("statement_affected",) if any(one.affects_validity for one in supplied) else ()
        return ("statement_item", *affected, "statement_reproduction")

    @property
    def valid_instruments(self) -> bool:
        """Whether every instrument that the result rests on has a certificate that is its own."""
        return not uncertified(self.found)

    @property
    def attachments(self) -> tuple[Attached, ...]:
        """The files that go with it: the result, the readings, the seal of the record."""
        found = self.found
        return (
            Attached("result.json", "application/json", "the result", found.result_json.encode()),
            Attached("readings.csv", "text/csv", "the readings", found.readings_csv.encode()),
            Attached("seal.json", "application/json", "the record of the run", found.record.seal.encode()),
        )


def stated(of: Verification) -> tuple[Statement, tuple[Statement, ...]]:
    """Return the statement of conformity as its rule makes it, on the whole and on each verification point."""
    points = tuple(by_rule(one.statement, of.rule, passed=one.passed) for one in of.points)
    missing = (Statement.NOT_COMPLETE,) if of.missing else ()
    return max((*points, *missing), key=list(Statement).index), points


def uncertified(found: RunFindings) -> tuple[str, ...]:
    """Return the voltmeters and the head of which no certificate counts."""
    return tuple(
        one.name
        for one in found.instruments
        if one.role in {"voltmeter", "head"} and (one.certificate is None or one.foreign)
    )


def rule_said(say: Callable[..., Said], rule: DecisionRule) -> Said:
    """Return a decision rule in the words of a language; `say` has them."""
    if rule.guard_band is None:
        return say("rule_unstated", times=f"{100 * FALSE_ACCEPTANCE:g}")
    return say(_RULES[rule.name], times=f"{rule.guard_band:g}")


def day_of(time: str) -> datetime.date | None:
    """Return the day of a civil time (ISO 8601); None where there is none."""
    try:
        return datetime.datetime.fromisoformat(time).date()
    except ValueError:
        return None
