"""The typed content of a certificate, as ISO/IEC 17025:2017, 7.8 requires it, independent of PDF and XML.

The content does not depend on date, folder or user. The same record, input files and `Issue` therefore always
give the same bytes of PDF and XML.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

from bench.base.arrays import Floats
from bench.calibration.conformity import (
    FALSE_ACCEPTANCE,
    GUARDED,
    NON_BINARY,
    SIMPLE,
    DecisionRule,
    Statement,
)
from bench.calibration.verification import Verification, by_rule
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

Said = TypeVar("Said")
_RULES: Final = {SIMPLE: "rule_simple", GUARDED: "rule_guarded", NON_BINARY: "rule_non_binary"}


@dataclass(frozen=True)
class Value:
    """A result in `unit`: standard uncertainty u, expanded uncertainty U = k u, degrees of freedom of u."""

    name: str
    value: float
    u: float
    U: float
    k: float
    dof: float
    unit: str


@dataclass(frozen=True)
class Values:
    """A group of n results; their `covariance` (n, n) is in the order and the units of `values`."""

    values: tuple[Value, ...]
    covariance: Floats

    def __getitem__(self, name: str) -> Value:
        return next(value for value in self.values if value.name == name)


@dataclass(frozen=True)
class Condition:
    """A quantity that influences the calibration, with its range during the run, `low` to `high`, in `unit`.

    `key` is the key of the quantity's name in `words.yaml`; `about` fills the blank in that name, for example with
    the supply rail. `u` is the standard uncertainty of the quantity, None if only the range is known. `source`
    names the sensor or the estimate behind the values.
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
    """An instrument used in the run, with its certificate on the day of the run.

    `identity` is the instrument's answer to the identification query. `expired` says whether the certificate
    had expired, `later` whether it is dated after the run, `foreign` whether it belongs to another instrument.
    """

    name: str
    role: str
    identity: str
    serial: str
    certificate: Held | None = None
    expired: bool = False
    foreign: bool = False
    later: bool = False

    @property
    def certified(self) -> bool:
        """Whether the instrument had a valid certificate of its own on the day of the run."""
        return self.certificate is not None and not (self.expired or self.foreign or self.later)


@dataclass(frozen=True)
class Contribution:
    """A source of uncertainty: the readings with the stand, or a source that does not show in their scatter.

    `size` is the magnitude of the source in words, empty for the readings. `most_in` names the coefficient to
    whose u the source contributes the largest fraction, and `u` (in `unit`) is this contribution. If `prior` is
    True, `size` is the program's assumption, because nobody stated it for this bench.
    """

    name: str
    size: str
    origin: str
    prior: bool
    u: float
    most_in: str
    unit: str


@dataclass(frozen=True)
class Item:
    """The unit under test, as the record names it."""

    type: str
    serial: str


@dataclass(frozen=True)
class Method:
    """The calibration method: procedure, hash of the plan, estimator and measurement model.

    `procedure` and `plan_hash` are empty if the record does not state them, as for some imported readings.
    """

    procedure: str
    plan_hash: str
    estimator: str
    model: str


@dataclass(frozen=True)
class RunReference:
    """The record of the run, from which the results can be reproduced.

    `events` is the number of events, `head` the SHA-256 of the last event. `seal` is the seal as JSON and
    `sealed` its time. For an unsealed run, `sealed` is empty, and `seal` is unsigned, made from the record.
    """

    run: str
    events: int
    head: str
    seal: str
    sealed: str


@dataclass(frozen=True)
class RunFindings:
    """The results of a run on a unit. `begun` and `ended` are civil times (ISO 8601), empty if unknown.

    `result` is the complete calibration, `verdict` the complete verification, None if no verification point
    was measured. `result_json` and `readings_csv` are the contents of two files attached to the certificate.
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
    intrinsic: Values
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
    def days(self) -> tuple[datetime.date, datetime.date] | None:
        """The first and the last day of the run; None if the record does not state them."""
        first, last = day_of(self.begun), day_of(self.ended)
        return None if first is None or last is None else (first, last)

    @property
    def verification(self) -> Verification | None:
        """The check at the verification points; None if no such point was measured."""
        return None if self.verdict is None else self.verdict.verification


@dataclass(frozen=True)
class Before:
    """A superseded certificate; `kind` is "amended" or "replaced", `sha256` is the hash of its XML."""

    kind: str
    number: str
    issued: str
    reason: str
    sha256: str


@dataclass(frozen=True)
class Issue:
    """The issue of a certificate: its number, time (ISO 8601, to the second), and who authorised it.

    `signed_by` is the name in the signing key's X.509 certificate, empty for an unsigned certificate.
    """

    number: str
    issued: str
    authorised_by: Person
    before: Before | None = None
    signed_by: str = ""

    @property
    def day(self) -> str:
        """The day on which the certificate was issued."""
        return self.issued[:10]


@dataclass(frozen=True)
class Attached:
    """A file attached to the certificate."""

    name: str
    media_type: str
    description: str
    content: bytes


@dataclass(frozen=True)
class Certificate:
    """A certificate. `issue` is None for a draft; `laboratory` and `order` are None if not given.

    `unit` is the order's entry for this unit; `as_found` are the results of a run before an adjustment.
    `texts` are the words in the chosen languages, the main language first.
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
        """Whether the certificate is a draft, without a number."""
        return self.issue is None

    @property
    def unsigned(self) -> bool:
        """Whether the certificate is numbered but not signed; every page then says so."""
        return self.issue is not None and not self.issue.signed_by

    @property
    def simulated(self) -> bool:
        """Whether the instruments were simulated; every page then says so."""
        return self.found.simulated

    @property
    def number(self) -> str:
        """The number of the certificate, empty for a draft."""
        return "" if self.issue is None else self.issue.number

    @property
    def k(self) -> float:
        """The coverage factor k of the expanded uncertainties of the coefficients."""
        return self.found.coefficients.values[0].k

    @property
    def coverage(self) -> float:
        """The coverage probability of `k` for a normal distribution."""
        return math.erf(self.k / math.sqrt(2.0))

    @property
    def coverage_percent(self) -> str:
        """The coverage probability in percent, below 100: 95.45 for k = 2, 99.9999 for k = 5."""
        percent = 100.0 * self.coverage
        return f"{percent:.4g}" if percent < 99.99 else f"{percent:.6g}"

    @property
    def place(self) -> str:
        """The place of the calibration; empty if not stated."""
        stated = self.order.place if self.order is not None else None
        return stated or (self.laboratory.place if self.laboratory is not None else "")

    @property
    def calibrated(self) -> tuple[datetime.date, datetime.date] | None:
        """The first and the last day of the calibration; None if not stated."""
        stated = None if self.unit is None else self.unit.calibrated
        return self.found.days or (None if stated is None else (stated, stated))

    @property
    def uncertified(self) -> tuple[str, ...]:
        """The voltmeters and heads that lacked a valid certificate on the day of the run, or of that as found."""
        runs = [self.found] if self.as_found is None else [self.found, self.as_found]
        used = (one for run in runs for one in run.instruments)
        lacking = (one.name for one in used if one.role in {"voltmeter", "head"} and not one.certified)
        return tuple(dict.fromkeys(lacking))

    @property
    def why_untraced(self) -> str:
        """Why instruments without a valid certificate were accepted, or their names; "" if none lacks it."""
        agreed = None if self.order is None else self.order.without_certificates
        return (agreed or ", ".join(self.uncertified)) if self.uncertified else ""

    @property
    def state(self) -> str:
        """The state of the unit to which the results apply, as found or as left; empty if not stated."""
        return "" if self.unit is None else self.unit.state

    @property
    def origins(self) -> dict[str, list[tuple[str, dict[str, str]]]]:
        """Statements on what does not come from the laboratory: sampling, external results, customer data.

        Each heading maps to a list of sentences. A sentence is a key in `words.yaml` with the values for the
        blanks. The result is empty without an order. Source: ISO/IEC 17025:2017, 7.8.2.1 k and p, 7.8.2.2.
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
        """The additional fields of this certificate, from the laboratory file and the order file."""
        return tuple(stated_fields(self.laboratory, self.unit, self.order))

    @property
    def terms(self) -> tuple[str, ...]:
        """The keys in `words.yaml` of the general statements on the first page."""
        supplied = () if self.order is None else self.order.supplied
        affected = ("statement_affected",) if any(one.affects_validity for one in supplied) else ()
        return ("statement_item", *affected, "statement_reproduction")

    @property
    def attachments(self) -> tuple[Attached, ...]:
        """The attached files: the result, the readings, the seal of the record."""
        found = self.found
        return (
            Attached("result.json", "application/json", "the result", found.result_json.encode()),
            Attached("readings.csv", "text/csv", "the readings", found.readings_csv.encode()),
            Attached("seal.json", "application/json", "the record of the run", found.record.seal.encode()),
        )


def stated(of: Verification) -> tuple[Statement, tuple[Statement, ...]]:
    """Return the overall statement of conformity and the statement for each judged verification point.

    The overall statement is the worst of these, and at best `NOT_COMPLETE` if a point could not be judged.
    """
    points = tuple(by_rule(one.statement, of.rule, passed=one.passed) for one in of.points)
    missing = (Statement.NOT_COMPLETE,) if of.missing else ()
    return max((*points, *missing), key=list(Statement).index), points


def rule_said(say: Callable[..., Said], rule: DecisionRule) -> Said:
    """Return a decision rule in words; `say` is the function that gives the text of a key."""
    if rule.guard_band is None:
        return say("rule_unstated", times=f"{100 * FALSE_ACCEPTANCE:g}")
    return say(_RULES[rule.name], times=f"{rule.guard_band:g}")


def day_of(time: str) -> datetime.date | None:
    """Return the day of a civil time (ISO 8601); None for any other text."""
    try:
        return datetime.datetime.fromisoformat(time).date()
    except ValueError:
        return None
