"""Laboratory files: who calibrates, how certificates are numbered, where they are kept, who may authorise them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field, PrivateAttr, field_validator

from bench.base.form_mistakes import Place, unknown_word
from bench.base.forms import Document, FileModel, load_document, part, validated
from bench.certificate.texts import LANGUAGES, texts_of
from bench.files.bench.stand import StatedRule

SIMULATED_SERIES: Final = "SIM-"
"""What the numbers of simulated runs begin with, and those of no others."""

_FIELD: Final = re.compile(r"\{(year|count)(?::0?([1-9]))?\}")
_PLAIN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,60}")


class Address(FileModel):
    """A postal address; `country` is the code of ISO 3166-1, two letters."""

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
        """The address as it stands on a letter."""
        return self.street, f"{self.post_code} {self.city}, {self.country}"


class Contact(FileModel):
    """A company or an authority, and how it is reached."""

    name: str
    address: Address
    email: str | None = None
    phone: str | None = None


class Person(FileModel):
    """Somebody who may authorise certificates."""

    name: str
    role: str | None = None


class Accreditation(FileModel):
    """By whom a laboratory is accredited, and under which number."""

    body: str
    number: str
    standard: str = "ISO/IEC 17025:2017"


def _languages(written: object) -> object:
    return (written,) if isinstance(written, str) else written


def _language(written: object) -> object:
    if not isinstance(written, str) or written not in LANGUAGES:
        raise ValueError(unknown_word(str(written), list(LANGUAGES), "language"))
    return written


Language = Annotated[str, BeforeValidator(_language)]


class Laboratory(Contact, StatedRule):
    """A laboratory file, validated; paths are as they were written, relative to the file.

    `rule` and `guard_band` are its decision rule where neither order nor record states one, `numbers` is the scheme
    of certificate numbers, `k` the coverage factor of U of the coefficients, `texts` are its own words by language
    and key in place of the program's.
    """

    accreditation: Accreditation | None = None
    logo: str | None = None
    place: str
    environment: str | None = None
    numbers: str = "{year}-{count:04}"
    register_: Annotated[str, Field(alias="register")]
    authorised: Annotated[tuple[Person, ...], Field(min_length=1)]
    k: Annotated[float, Field(ge=1.0, le=5.0)] = 2.0
    language: Annotated[
        tuple[Language, ...], BeforeValidator(_languages), Field(min_length=1, max_length=2)
    ] = ("en",)
    texts: Mapping[Language, Mapping[str, str]] = {}
    _file: Path = PrivateAttr(default=Path())
    _logo: Path | None = PrivateAttr(default=None)

    @field_validator("numbers")
    @classmethod
    def _a_scheme(cls, scheme: str) -> str:
        if len(re.findall(r"\{count", scheme)) != 1 or _PLAIN.fullmatch(_FIELD.sub("0", scheme)) is None:
            raise ValueError(
                f"expected a scheme such as '{{year}}-{{count:04}}', of letters, digits, . _ - and {{count}}, got "
                f"'{scheme}'"
            )
        if scheme.upper().startswith(SIMULATED_SERIES):
            raise ValueError(f"numbers that begin with {SIMULATED_SERIES} are those of simulated runs")
        return scheme

    @field_validator("language")
    @classmethod
    def _each_once(cls, languages: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(languages)) < len(languages):
            raise ValueError(f"{languages[0]} stands twice")
        return languages

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield texts of its own that no certificate has a place for."""
        stated = part(data, "texts")
        for language in stated if isinstance(stated, dict) else ():
            own = stated[language]
            if language not in LANGUAGES or not isinstance(own, dict):
                continue
            known = sorted(texts_of(language).entries)
            for key in own:
                if key not in known:
                    yield ("texts", language, key), unknown_word(str(key), known, "text")

    @property
    def register_folder(self) -> Path:
        """The folder of its register."""
        return self._file.parent / self.register_

    @property
    def logo_file(self) -> Path | None:
        """The picture of its logo, None where it has none."""
        return self._logo or (None if self.logo is None else self._file.parent / self.logo)

    def number(self, count: int, year: int, *, simulated: bool) -> str:
        """Return the number of the `count`-th certificate of a year."""

        def filled(field: re.Match[str]) -> str:
            return f"{year if field[1] == 'year' else count:0{field[2] or 1}d}"

        return (SIMULATED_SERIES if simulated else "") + _FIELD.sub(filled, self.numbers)

    @property
    def counts_by_year(self) -> bool:
        """Whether counting begins anew each year."""
        return "{year" in self.numbers

    def person(self, name: str) -> Person | None:
        """Return who is called so among those that may authorise; None for another."""
        return next((one for one in self.authorised if one.name == name), None)


def load_laboratory(path: Path) -> Laboratory:
    """Read a laboratory file. Raises `FileMistakes` with every mistake in it."""
    return laboratory_of(load_document(path))


def laboratory_of(document: Document, logo: Path | None = None) -> Laboratory:
    """Return the laboratory of a file that was read; `logo` is a copy of its picture. Raises `FileMistakes`."""
    laboratory = validated(document, Laboratory)
    laboratory._file = document.path.absolute()
    laboratory._logo = logo
    return laboratory
