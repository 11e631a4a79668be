"""The persons of a laboratory: names, roles, rights and identities, in one register beside the laboratory file.

The register is a chain: each line adds or changes a person or ends a person's rights, and names the
administrator. It contains no secrets, only public keys and salted hashes of tokens. With a register, only its
persons operate, issue certificates, accept validations, close failures and sign in to the panel. Without one,
operators are free text, and the laboratory file names those who may authorise.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Final

from bench.base.files import read_regular
from bench.base.languages import message
from bench.base.text import as_typed, visible
from bench.results.registers import PersonChange, PersonPart, PersonsResult
from bench.run.events import OperatorPerson, RecordError
from bench.run.person import NOBODY_KNOWN, WishAuthor, at_the_shell
from bench.services.chain import LINES, Chain, Entry, civil_now, opened
from bench.services.errors import Refused
from bench.services.requests.documents import ChangePersons, PersonsCommand, Right
from bench.services.validated import laboratory_known, laboratory_needed

TOKEN: Final = "BENCH_TOKEN"
KEY: Final = "BENCH_KEY"
STARTED_FROM: Final = "_BENCH_STARTED_FROM"
"""Environment variable with place and role of the person for whom a program starts this one: "panel operator"."""
LONGEST_NAME: Final = 60
ADDED, CHANGED, ENDED = "added", "changed", "ended"


@dataclass(frozen=True)
class Person:
    """A person: name, role, rights, the salted hash of a token, and a public key (PEM); the last two may be "".

    `since` and `ended` are times (ISO 8601); `ended` is "" while the person has rights.
    """

    name: str
    role: str
    may: frozenset[Right]
    token: str = ""
    public_key: str = ""
    since: str = ""
    ended: str = ""

    def has_token(self, token: str) -> bool:
        """Return whether this is the person's token."""
        salt = self.token.partition(":")[0]
        return bool(self.token) and secrets.compare_digest(_salted(token, salt), self.token)


@dataclass
class Persons(Chain):
    """The register: `everyone` by name, also those whose rights have ended; `entries` are its lines."""

    KIND: ClassVar[str] = "persons"

    everyone: dict[str, Person] = field(default_factory=dict)
    entries: list[Entry] = field(default_factory=list)

    def _note(self, entry: Entry, where: str) -> bool:
        name, before = entry.number, self.everyone.get(entry.number)
        present = before is not None and not before.ended
        if entry.kind not in {ADDED, CHANGED, ENDED} or present == (entry.kind == ADDED):
            return False
        if entry.kind == ENDED and before is not None:
            self.everyone[name] = replace(before, ended=entry.time)
        else:
            told = {one: str(entry.data[one]) for one in ("role", "token", "public_key")}
            may = frozenset(map(Right, entry.data["may"]))
            self.everyone[name] = Person(name, may=may, since=entry.time, **told)
        self.entries.append(entry)
        return True

    def who_may(self, right: Right) -> list[Person]:
        """Return the persons who have this right at present."""
        return [one for one in self.everyone.values() if not one.ended and right in one.may]

    def with_token(self, token: str) -> Person | None:
        """Return the person with this token; None if nobody has it, or that person's rights have ended."""
        return next((one for one in self.everyone.values() if not one.ended and one.has_token(token)), None)

    def chosen(self, name: str, right: Right, option: str) -> Person:
        """Return the person called `name`. Raises `Refused`, naming the option, for a person without the right."""
        able = {one.name: one for one in self.who_may(right)}
        if name in able:
            return able[name]
        known = self.everyone.get(name)
        if known is None:
            why = "no such person"
        elif known.ended:
            why = f"the person's rights ended on {known.ended[:10]}"
        else:
            why = f"the person may not {right}"
        remedy = (
            f"name one who may {right}: {', '.join(able)}"
            if able
            else f"give the right with {_to_give(right, name, known)}"
        )
        raise Refused(f"{option} {visible(name)}: {why} in {self.folder}; {remedy}")


def _to_give(right: Right, name: str, known: Person | None) -> str:
    """Return the command that gives a person a right; `--may` lists all rights, also those that the person has."""
    what, has = ("add", ()) if known is None or known.ended else ("change", known.may)
    rights = ",".join(sorted({*has, right}))
    return f"'bench persons {what} {as_typed(visible(name))} --may {rights} --by NAME'"


def persons_of(laboratory: Path | None) -> Persons | None:
    """Return the register beside a laboratory file, read only; None if there is none. Raises `Refused`."""
    register = None if laboratory is None else Persons.beside(laboratory)
    return register.read_lines() if register and (register.folder / LINES).exists() else None


def authorised_by(laboratory: Path, name: str, right: Right, option: str) -> Person | None:
    """Return the named person after a check of right and identity; None without register. Raises `Refused`."""
    register = persons_of(laboratory)
    return None if register is None else _proved(register.chosen(name, right, option))


def _proved(person: Person) -> Person:
    """Return the person if the token or key was given or there is neither. Raises `Refused` otherwise."""
    if not person.token and not person.public_key:
        return person
    if person.has_token(os.environ.get(TOKEN, "")) or _holds_key(person, os.environ.get(KEY)):
        return person
    ways = [f"{TOKEN} to the token"] * bool(person.token) + [f"{KEY} to the key file"] * bool(
        person.public_key
    )
    given = [name for name in (TOKEN, KEY) if os.environ.get(name)]
    wrong = f", and {' and '.join(given)} of another was given" if given else ""
    raise Refused(f"{person.name} must prove who acts{wrong}; set {' or '.join(ways)}")


def _holds_key(person: Person, file: str | None) -> bool:
    from bench.run.seal import private_key, sign

    if not person.public_key or not file:
        return False

    def no_passphrase() -> bytes:
        raise Refused(f"{KEY} {file}: the key has a passphrase; use one without, or a token")

    return sign(private_key(Path(file), no_passphrase), b"")[0].strip() == person.public_key.strip()


# --- operators --------------------------------------------------------------------------------------


def operator_of(name: str, laboratory: Path | None, *, needed: bool) -> tuple[str, OperatorPerson | None]:
    """Return the operator's name, and role and rights for the record (None without register). Raises `Refused`."""
    if re.search("[\ud800-\udfff]", name):
        raise Refused("--operator: the name is not UTF-8 text; set the terminal to UTF-8 and type it again")
    register = persons_of(laboratory_known(laboratory))
    if register is None or (not name and not needed):
        return name, None
    if not name:
        names = ", ".join(one.name for one in register.who_may(Right.OPERATE)) or "nobody"
        raise Refused(
            f"{register.folder} lists who may operate, but no operator is named; give --operator NAME, "
            f"one of: {names}"
        )
    person = register.chosen(name, Right.OPERATE, "--operator")
    return name, {"role": person.role, "may": sorted(person.may), "register": register.head}


def acting_at(where: str, name: str, laboratory: Path | None = None) -> WishAuthor:
    """Return who acts at `where`: a person of the register, else this computer's user.

    Raises the errors of `operator_of`.
    """
    chosen, person = operator_of(name, laboratory, needed=False)
    user = at_the_shell(where)
    if not chosen:
        return user
    role = user.role if person is None or Right.SUPERVISE in person["may"] else "operator"
    return WishAuthor(chosen, role, where)


def resumer(where: str, name: str) -> WishAuthor:
    """Return the person to record as resuming a run; nobody if there is neither a `name` nor a register.

    `where` is a place, or a place and the person's role there, separated by a space.
    """
    place, _, role = where.partition(" ")
    by = acting_at(place, name)
    by = replace(by, role=role or by.role)
    return by if name or persons_of(laboratory_known(None)) is not None else NOBODY_KNOWN


# --- changes ----------------------------------------------------------------------------------------


def persons(request: ChangePersons) -> PersonsResult:
    """Carry out the requested change of the register, if any; return the register. Raises `Refused`."""
    laboratory = laboratory_needed(
        request.laboratory, message("the register of persons is a folder beside it")
    )
    if request.what is None:
        return _listed(persons_of(laboratory) or Persons.beside(laboratory))
    needed = {"NAME": request.name, "--by NAME": request.by}
    if request.what is PersonsCommand.END:
        needed["--reason TEXT"] = request.reason
    if lacking := [option for option, given in needed.items() if not given]:
        raise Refused(f"bench persons {request.what} needs {', '.join(lacking)}; add what is missing")
    name, by = checked_name(str(request.name)), str(request.by)
    with opened(Persons.beside(laboratory)) as register:
        if register.entries:
            _proved(register.chosen(by, Right.ADMINISTER, "--by"))
        token = secrets.token_urlsafe(32) if request.token else None
        entry = _entry(register, request, name, by, token)
        if not any(one.name != name for one in register.who_may(Right.ADMINISTER)) and (
            entry.kind == ENDED or Right.ADMINISTER not in entry.data["may"]
        ):
            remedy = (
                message("first give another person this right")
                if entry.kind == ENDED
                else f"give --may {','.join(sorted({*entry.data['may'], Right.ADMINISTER}))}"
            )
            raise Refused(f"{name}: nobody would be left who may administer; {remedy}")
        register.append(entry)
        return _listed(register, token)


def _entry(register: Persons, request: ChangePersons, name: str, by: str, token: str | None) -> Entry:
    """Return the register line for a change. Raises `Refused` for adding a known or changing an unknown person."""
    before = register.everyone.get(name)
    present = before is not None and not before.ended
    if present == (request.what is PersonsCommand.ADD):
        if present:
            raise Refused(f"{name}: is in the register {register.folder} already; use 'bench persons change'")
        way = (
            message("'bench persons' lists all")
            if request.what is PersonsCommand.END
            else "use 'bench persons add'"
        )
        raise Refused(f"{name}: is not in the register {register.folder}; {way}")
    now, why = civil_now(), {"reason": request.reason or ""}
    if request.what is PersonsCommand.END:
        return Entry(ENDED, name, now, by, why)
    old = before if before is not None and present else Person(name, "", frozenset())
    data: dict[str, Any] = {
        "role": old.role if request.role is None else request.role,
        "may": sorted(old.may if request.may is None else _rights(request.may)),
        "token": old.token if token is None else _salted(token, secrets.token_hex(16)),
        "public_key": old.public_key if request.public_key is None else _public_key(request.public_key),
        **why,
    }
    return Entry(CHANGED if present else ADDED, name, now, by, data)


def _rights(text: str) -> list[Right]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    if unknown := [word for word in words if word not in list(Right)]:
        raise Refused(f"--may {', '.join(unknown)}: choose from {', '.join(Right)}, with commas between")
    return [Right(word) for word in words]


def _public_key(file: Path) -> str:
    from bench.run.seal import read_public_key

    read_public_key(file)  # refuses what is none
    return read_regular(file).decode("ascii")


def _listed(register: Persons, token: str | None = None) -> PersonsResult:
    return PersonsResult(
        register_=str(register.folder),
        head=register.head,
        token=token,
        persons=[
            PersonPart.from_object(one, may=sorted(one.may), has_token=bool(one.token))
            for one in register.everyone.values()
        ],
        changes=[
            PersonChange.from_object(
                one, name=one.number, reason=str(one.data.get("reason", "")),
                role=one.data.get("role"), may=one.data.get("may"),
            )
            for one in register.entries
        ],
    )  # fmt: skip


def checked_name(name: str) -> str:
    """Return a person's name, stripped. Raises `RecordError` if it is empty, too long or not printable."""
    name = name.strip()
    if not name or len(name) > LONGEST_NAME or not name.isprintable() or visible(name) != name:
        raise RecordError(f"{visible(name)!r}: give a name of 1 to {LONGEST_NAME} printable characters")
    return name


def _salted(token: str, salt: str) -> str:
    """Return salt and salted SHA-256 of a token; its 256 random bits need no slow password hash."""
    return f"{salt}:{hashlib.sha256(f'{salt}:{token}'.encode(errors='replace')).hexdigest()}"
