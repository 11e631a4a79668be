"""Laboratory files (who calibrates), order files (who ordered what), and the texts of a certificate.

To show a new field of these files on the certificate, mark it with `OnCertificate` and add a text with the
field's name as its key to `words.yaml`. The field then appears on the marked page, and in the DCC.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import BeforeValidator, Field, PrivateAttr, ValidationInfo, field_validator, model_validator

from bench.base.languages import ENGLISH, known_language, local_number, speaking
from bench.base.yaml_files import (
    Document,
    FileModel,
    Place,
    load_document,
    load_validated,
    part,
    unknown_word,
    validated,
)
from bench.calibration.conformity import Statement
from bench.config.bench_file.stand import StatedRule
from bench.config.devices.device import Day
from bench.services.errors import Refused
from bench.services.requests.documents import Right

SIMULATED_SERIES: Final = "SIM-"
"""Prefix of the certificate numbers of simulated runs; no other number begins with it."""

_FIELD: Final = re.compile(r"\{(year|count)(?::0?([1-9]))?\}")
_PLAIN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,60}")


_WORDS_FILE: Final = Path(__file__).with_name("words.yaml")
_WORDS: Final = yaml.safe_load(_WORDS_FILE.read_text(encoding="utf-8"))
LANGUAGES: Final = tuple(sorted({language for words in _WORDS.values() for language in words}))
"""The supported languages, by their ISO 639-1 codes."""

_BLANK: Final = re.compile(r"\{([a-z_]+)\}")
_FIXED: Final = frozenset({
    "draft", "draft_unsigned_text", "simulated", "unsigned", "unsigned_text", "statement_unsigned", "expired",
    "no_certificate", "untraced_text", "statement_affected", "accepted", "not_accepted", *map(str, Statement),
})  # fmt: skip
"""Keys of the texts that limit what a certificate is worth, and of the statements of conformity."""

_AS_ISSUED: Final = "as issued"
"""Context of a file that was stored when a certificate was issued: its texts are not judged again."""


@dataclass(frozen=True)
class Texts:
    """The texts of a certificate in one language, by key; `{name}` in a text is a blank to be filled."""

    language: str
    entries: Mapping[str, str]

    def say(self, key: str, **values: object) -> str:
        """Return a text with its blanks filled. Raises `Refused` for an unknown key, `KeyError` without a value."""
        if key not in self.entries:
            raise Refused(f"{_WORDS_FILE}: there is no text '{key}'; add it, at least in English")
        with speaking(known_language(self.language) or ENGLISH):
            return _BLANK.sub(lambda blank: local_number(str(values[blank[1]])), self.entries[key])


def in_each(texts: Sequence[Texts], key: str, **values: object) -> list[str]:
    """Return the text `key` in each language; a list in `values` has a wording for each language."""
    return [
        text.say(key, **{name: of[i] if isinstance(of, list) else of for name, of in values.items()})
        for i, text in enumerate(texts)
    ]


@cache
def texts_of(language: str) -> Texts:
    """Return the texts of a language of `LANGUAGES`; a text that is missing in this language is in English."""
    found = {key: words.get(language, words.get(ENGLISH)) for key, words in _WORDS.items()}
    return Texts(language, {key: str(text).strip() for key, text in found.items() if text is not None})


@dataclass(frozen=True)
class OnCertificate:
    """A mark for a field of a laboratory or order file: the certificate shows the field under its own name.

    `page` is the page of the PDF. `otherwise` is the key in `words.yaml` of a text to print if the file does
    not state the field. Rows with `otherwise` are always printed, and come first.
    """

    page: Literal["front", "method", "conditions"]
    otherwise: str = ""


@dataclass(frozen=True)
class StatedField:
    """A field on a certificate: the key of its label, its `texts` (possibly none) and its page."""

    key: str
    texts: tuple[str, ...]
    place: OnCertificate


def stated_fields(
    laboratory: Laboratory | None, unit: UnitOrder | None, order: Order | None
) -> Iterator[StatedField]:
    """Yield a `StatedField` for each field marked with `OnCertificate`; a field not stated has no texts."""
    for model, file in ((Laboratory, laboratory), (UnitOrder, unit), (Order, order)):
        for name, field in (type(file) if file else model).model_fields.items():
            for place in (one for one in field.metadata if isinstance(one, OnCertificate)):
                value = getattr(file, name, None)
                several = value if isinstance(value, tuple) else () if value is None else (value,)
                yield StatedField(name, tuple(map(str, several)), place)


class Printed(FileModel):
    """A part of a file whose texts are printed: spaces around a text are removed, and spaces alone are no text."""

    @model_validator(mode="before")
    @classmethod
    def _without_spaces(cls, data: Any, info: ValidationInfo) -> Any:
        return _stripped(data, spaces_alone=info.context == _AS_ISSUED)


def _stripped(data: Any, *, spaces_alone: bool) -> Any:
    """Return data without spaces around their texts; texts of `spaces_alone` stay, or become empty."""
    if isinstance(data, dict):
        return {name: _stripped(value, spaces_alone=spaces_alone) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_stripped(value, spaces_alone=spaces_alone) for value in data]
    return (data.strip() or data * spaces_alone) if isinstance(data, str) else data


class Address(Printed):
    """A postal address; `country` is the two-letter code of ISO 3166-1."""

    street: str
    post_code: str
    city: str
    country: str

    @field_validator("country")
    @classmethod
    def _two_letters(cls, country: str) -> str:
        if re.fullmatch(r"[A-Z]{2}", country) is None:
            raise ValueError(
                f"expected the two letters of a country (ISO 3166-1) such as UA, got '{country}'"
            )
        return country

    @property
    def lines(self) -> tuple[str, ...]:
        """The address as the lines of a letterhead."""
        return self.street, f"{self.post_code} {self.city}, {self.country}"


class Contact(Printed):
    """The contact data of a company or an authority."""

    name: str
    address: Address
    email: str | None = None
    phone: str | None = None


class Person(Printed):
    """A person who may authorise certificates."""

    name: str
    role: str | None = None


class Accreditation(Printed):
    """The accreditation of a laboratory: the accreditation body, the number and the last day, if it is stated."""

    body: str
    number: str
    standard: str = "ISO/IEC 17025:2017"
    valid_until: Day | None = None


def _language(written: object) -> object:
    if not isinstance(written, str) or written not in LANGUAGES:
        raise ValueError(unknown_word(str(written), list(LANGUAGES), "language"))
    return written


Language = Annotated[str, BeforeValidator(_language)]


class Laboratory(Contact, StatedRule):
    """A validated laboratory file. Paths in it are relative to the file.

    `rule` and `guard_band` are the decision rule if neither order nor record states a rule. `numbers` is the
    scheme of certificate numbers, and `k` the coverage factor of the coefficients. `texts` replaces the
    program's texts, by language and key. With `require_validation`, real runs and certificates need a program
    whose validation was accepted.
    """

    accreditation: Accreditation | None = None
    logo: str | None = None
    place: str
    environment: Annotated[str | None, OnCertificate("conditions")] = None
    numbers: str = "{year}-{count:04}"
    register_: Annotated[str, Field(alias="register")]
    authorised: Annotated[tuple[Person, ...], Field(min_length=1)] = ()
    k: Annotated[float, Field(ge=1.0, le=5.0)] = 2.0
    language: Annotated[
        tuple[Language, ...],
        BeforeValidator(lambda written: (written,) if isinstance(written, str) else written),
        Field(min_length=1, max_length=2),
    ] = ("en",)
    texts: Mapping[Language, Mapping[str, str]] = {}
    require_validation: bool = False
    _file: Path = PrivateAttr(default=Path())
    _logo: Path | None = PrivateAttr(default=None)

    @field_validator("numbers")
    @classmethod
    def _a_scheme(cls, scheme: str) -> str:
        if len(re.findall(r"\{count", scheme)) != 1 or _PLAIN.fullmatch(_FIELD.sub("0", scheme)) is None:
            raise ValueError(
                f"expected a scheme such as '{{year}}-{{count:04}}', of letters, digits, . _ - and {{count}} "
                f"once, got '{scheme}'"
            )
        if scheme.upper().startswith(SIMULATED_SERIES):
            raise ValueError(
                f"numbers with the prefix {SIMULATED_SERIES} are for simulated runs; choose another"
            )
        return scheme

    @field_validator("language")
    @classmethod
    def _each_once(cls, languages: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(languages)) < len(languages):
            raise ValueError(f"{languages[0]} appears twice; keep one")
        return languages

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield place and mistake for each entry of `texts` whose key no certificate uses."""
        stated = part(data, "texts")
        for language in stated if isinstance(stated, dict) else ():
            own = stated[language]
            if language not in LANGUAGES or not isinstance(own, dict):
                continue
            known = texts_of(language).entries
            for key, text in own.items():
                if key not in known:
                    yield ("texts", language, key), unknown_word(str(key), sorted(known), "text")
                elif key in _FIXED:
                    yield ("texts", language, key), "no laboratory may replace this text; remove it"
                else:
                    blanks, usual = (set(_BLANK.findall(str(one))) for one in (text, known[key]))
                    if blanks - usual or "statement" in usual - blanks:
                        there = ", ".join(f"{{{name}}}" for name in sorted(usual))
                        expected = f"the blanks {there}" if there else "no blanks"
                        yield ("texts", language, key), f"expected {expected}; keep the names in braces"

    @property
    def register_folder(self) -> Path:
        """The folder of the laboratory's certificate register."""
        return self._file.parent / self.register_

    @property
    def logo_file(self) -> Path | None:
        """The picture file of the laboratory's logo; None without a logo."""
        return self._logo or (None if self.logo is None else self._file.parent / self.logo)

    def number(self, count: int, year: int, *, simulated: bool) -> str:
        """Return the `count`-th certificate number of a year, such as "2026-0003"; "SIM-…" if `simulated`."""

        def filled(field: re.Match[str]) -> str:
            return f"{year if field[1] == 'year' else count:0{field[2] or 1}d}"

        return (SIMULATED_SERIES if simulated else "") + _FIELD.sub(filled, self.numbers)

    def authorised_person(self, name: str, option: str = "--authorised-by") -> Person:
        """Return the person `name` if that person may authorise, else raise `Refused`.

        The register of persons decides; without one, this file does. The error message names `option`.
        """
        from bench.services.persons import authorised_by

        known = authorised_by(self._file, name, Right.AUTHORISE, option)
        if known is not None:
            return Person(name=known.name, role=known.role or None)
        for one in self.authorised:
            if one.name == name:
                return one
        if not self.authorised:
            raise Refused(
                f"{option} {name}: the laboratory file names nobody; add persons under 'authorised'"
            )
        names = ", ".join(one.name for one in self.authorised)
        raise Refused(f"{option} {name}: the laboratory file names {names}; choose one of them")


def load_laboratory(path: Path) -> Laboratory:
    """Read a laboratory file. Raises `FileMistakes` with every mistake in it."""
    return laboratory_of(load_document(path))


def laboratory_of(document: Document) -> Laboratory:
    """Return the laboratory in a loaded file. Raises `FileMistakes` with every mistake."""
    laboratory = validated(document, Laboratory)
    laboratory._file = document.path.absolute()
    return laboratory


def as_issued(laboratory: Path, order: Path, logo: Path | None) -> tuple[Laboratory, Order]:
    """Return laboratory and order from files stored with a certificate, as at its issue.

    Later rules for their texts do not apply. Raises `FileMistakes` or `ValueError` for a file that cannot be read.
    """
    house = Laboratory.model_validate(load_document(laboratory).data, context=_AS_ISSUED)
    house._logo = logo
    return house, Order.model_validate(load_document(order).data, context=_AS_ISSUED)


AS_FOUND, AS_LEFT = "as found", "as left"


class Adjusted(Printed):
    """An adjustment or repair; `as_found` is the run (name or path) that shows the unit before it."""

    what: str
    as_found: str | None = None

    def __str__(self) -> str:
        return self.what


class External(Printed):
    """Results from an external provider: `what` results, `by` whom (ISO/IEC 17025:2017, 7.8.2.1 p)."""

    what: str
    by: str


class Supplied(Printed):
    """Data from the customer that the certificate uses (ISO/IEC 17025:2017, 7.8.2.2).

    `affects_validity` states whether a wrong value could invalidate a result; if so, page 1 has the warning
    of 7.8.2.2.
    """

    what: str
    affects_validity: bool = True


class UnitOrder(Printed):
    """A unit in an order: its receipt, its condition, and whether the run shows it as found or as left.

    An entry without `serial` applies to all units. `calibrated` is the day of calibration if readings were
    imported without a date. `deviations` are deviations from the method.
    """

    serial: str | None = None
    manufacturer: str | None = None
    reference: str | None = None
    received: Day
    condition: str
    calibrated: Day | None = None
    state: Literal["as found", "as left"]
    adjusted: Annotated[Adjusted | None, OnCertificate("method")] = None
    deviations: Annotated[tuple[str, ...], OnCertificate("method", "no_deviations")] = ()

    @model_validator(mode="after")
    def _left_where_adjusted(self) -> UnitOrder:
        if self.adjusted is not None and self.state == AS_FOUND:
            raise ValueError(
                "'adjusted' contradicts 'state: as found', because an adjusted unit is 'as left'; write 'state: "
                "as left', and the run before the adjustment as 'as_found' under 'adjusted'"
            )
        return self


class Order(Printed, StatedRule):
    """A validated order file.

    `rule` and `guard_band` are the decision rule agreed with the customer, which overrides the rule in the
    record (ISO/IEC 17025:2017, 7.1.3); `agreed` are other agreements. `place` is the place of calibration if
    it was not the laboratory. `without_certificates` is why the customer accepts instruments without valid
    certificates. `sampling` is the sampling plan and method, and who sampled; without `sampling`, the
    customer supplied the units. `external` are results from other bodies, `supplied` data from the customer.
    """

    customer: Contact
    number: str
    date: Annotated[Day | None, OnCertificate("front")] = None
    units: Annotated[tuple[UnitOrder, ...], Field(min_length=1)]
    place: str | None = None
    agreed: Annotated[tuple[str, ...], OnCertificate("method")] = ()
    without_certificates: str | None = None
    sampling: str | None = None
    external: tuple[External, ...] = ()
    supplied: tuple[Supplied, ...] = ()

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield place and mistake for each unit that is listed again."""
        units = part(data, "units")
        seen: set[object] = set()
        for place, unit in enumerate(units if isinstance(units, list) else ()):
            serial = part(unit, "serial")
            if serial in seen:
                yield (
                    ("units", place),
                    f"unit {serial or 'without a serial number'} appears twice; keep one",
                )
            if serial is None or isinstance(serial, str):
                seen.add(serial)

    def unit(self, serial: str) -> UnitOrder | None:
        """Return the entry for a serial number, else the entry for all units; None if there is neither."""
        named = next((unit for unit in self.units if unit.serial == serial), None)
        return named or next((unit for unit in self.units if unit.serial is None), None)


def load_order(path: Path) -> Order:
    """Read an order file. Raises `FileMistakes` with every mistake in it."""
    return load_validated(path, Order)
