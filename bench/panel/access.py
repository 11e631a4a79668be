"""Access to the panel: its address; persons and roles; tokens, links and sessions; checks of requests."""

from __future__ import annotations

import ipaddress
import json
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bench.base.files import from_text, read_regular, to_text, write_whole
from bench.base.languages import known_language, message, speaking
from bench.base.text import as_typed
from bench.run.events import RecordError
from bench.services import persons as laboratory
from bench.services.persons import Persons, checked_name, persons_of
from bench.services.requests.documents import Right
from bench.services.requests.shared import runs_to_type
from bench.services.validated import laboratory_known
from drivers.clock import utc_now

STATE: Final = ".panel"
PORT: Final = 8741


@dataclass(frozen=True)
class Settings:
    """The settings of a panel for the runs in a folder.

    `address` is the public address of a TLS proxy in front of the panel, such as https://lab. `laboratory` is a
    laboratory file, whose register holds the certificates of the runs. `catalogue` is the file or URL of the
    catalogue that the pages on units show, empty for none.
    """

    runs: Path
    host: str = "127.0.0.1"
    port: int = PORT
    address: str = ""
    laboratory: Path | None = None
    catalogue: str = ""

    @property
    def loopback(self) -> bool:
        """Whether only this computer can reach the panel: its address is loopback, without a proxy."""
        return not self.address and is_loopback(self.host)

    @property
    def url(self) -> str:
        """The address of the panel for a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return self.address or f"http://{host}:{self.port}"

    @property
    def cookie(self) -> str:
        """The cookie name, unique for each panel on a computer, because cookies do not distinguish ports."""
        path = str(self.runs.resolve()).encode(errors="surrogateescape")
        return f"bench_panel_{sha256(path).hexdigest()[:8]}"

    def allows_host(self, host: str) -> bool:
        """Return whether the panel serves requests with this Host header; on loopback, local names only."""
        if self.loopback:
            return host in {f"{name}:{self.port}" for name in ("127.0.0.1", "localhost", "[::1]")}
        return bool(host)

    def allows_origin(self, origin: str, host: str) -> bool:
        """Return whether a page of this origin may request changes; only a page of the panel may."""
        return origin == (self.address or f"http://{host}")


def is_loopback(host: str) -> bool:
    """Return whether a host is `localhost` or a loopback address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Role(StrEnum):
    """The role of a person; each role has the rights of the roles before it.

    A viewer looks at runs and stops them, an operator carries them out, a supervisor takes control by force.
    """

    VIEWER = "viewer"
    OPERATOR = "operator"
    SUPERVISOR = "supervisor"

    def includes(self, other: Role) -> bool:
        """Return whether this role has all the rights of another role."""
        order = list(Role)
        return order.index(self) >= order.index(other)


@dataclass(frozen=True)
class Person:
    """A signed-in person: name, role, and the secret of the session (only the browser stores it)."""

    name: str
    role: Role
    secret: str = ""

    @property
    def csrf(self) -> str:
        """The CSRF token in this session's forms; it proves that a request comes from the panel."""
        return sha256(f"form:{self.secret}".encode()).hexdigest()[:32]

    def require(self, least: Role) -> None:
        """Raise `Refusal` (403) if the person's role is below `least`."""
        if not self.role.includes(least):
            raise Refusal(403, f"{self.name} is signed in as {self.role}; sign in as {least} for this")


class Refusal(Exception):
    """A refused request, with its HTTP status and a sentence for the user, which pages translate."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status, self.text = status, text


LARGEST_BODY: Final = 65_536
METHODS: Final = frozenset({"GET", "HEAD", "POST"})
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "font-src 'self'; frame-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",  # with "no-referrer" a browser sends the origin of a form as "null"
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Gate:
    """Middleware that refuses requests from foreign hosts and origins and limits the size of bodies."""

    def __init__(
        self, app: ASGIApp, settings: Settings, refuse: Callable[[Request, Refusal], Response]
    ) -> None:
        self._app, self._settings, self._refuse = app, settings, refuse

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request to the application, or respond with the reason for its refusal."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if (refusal := self._refused(scope)) is not None:
            await self._refuse(Request(scope), refusal)(scope, receive, with_headers)
            return
        taken = counted(receive) if scope["method"] == "POST" else without_body(receive)
        with speaking(_language_of(Request(scope))):
            await self._app(scope, taken, with_headers)

    def _refused(self, scope: Scope) -> Refusal | None:
        """Return the refusal of a request, judged by its headers; None if it may pass."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if len(headers.getlist("host")) > 1 or not self._settings.allows_host(host):
            return Refusal(403, f"the request names another address; open the panel at {self._settings.url}")
        if scope["method"] not in METHODS:
            return Refusal(405, "the panel accepts GET and POST only; use its pages")
        if scope["method"] == "POST" and not self._settings.allows_origin(headers.get("origin", ""), host):
            return Refusal(403, "another web page asked for this change; use the panel itself")
        length = headers.get("content-length", "0")
        if "content-length" in headers and "transfer-encoding" in headers:
            return Refusal(400, "the request has both Content-Length and Transfer-Encoding; send one")
        if not length.isascii() or not length.isdecimal() or len(length) > 9 or int(length) > LARGEST_BODY:
            return Refusal(413, _too_large())
        return None


def _too_large() -> str:
    return message(
        f"the form is larger than the panel accepts ({LARGEST_BODY} bytes); shorten its longest text, or change "
        "the file in an editor"
    )


LANGUAGE: Final = "bench-language"
"""The cookie with the language that a person chose; without it the browser's languages count."""


def _language_of(request: Request) -> str | None:
    """Return the language in the cookie, else the first known in Accept-Language; None means the default."""
    accepted = request.headers.get("accept-language", "")[:200].split(",")
    wanted = [request.cookies.get(LANGUAGE, ""), *(one.partition(";")[0] for one in accepted)]
    return next(filter(None, map(known_language, wanted)), None)


def counted(receive: Receive) -> Receive:
    """Return an ASGI `receive` that raises `Refusal` (413) for a body over `LARGEST_BODY` bytes."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        received = await receive()
        taken += len(received.get("body", b""))
        if taken > LARGEST_BODY:
            raise Refusal(413, _too_large())
        return received

    return bounded


def without_body(receive: Receive) -> Receive:
    """Return an ASGI `receive` that empties bodies: an event stream would refuse a large one too late."""

    async def dropped() -> Message:
        got = await receive()
        return {**got, "body": b""} if got["type"] == "http.request" else got

    return dropped


def private_folder(folder: Path) -> Path:
    """Return `folder`, created if missing and made private to its owner (0700). Raises `RecordError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode):
            raise RecordError(
                f"{folder}: a file or a symbolic link is where the panel needs a folder; "
                "remove the file or link"
            )
        if os.name == "posix" and stat.S_IMODE(found.st_mode) & 0o077:
            folder.chmod(0o700)
    except OSError as error:
        raise RecordError(
            f"{folder}: cannot be used ({error.strerror}); choose another folder of runs"
        ) from error
    return folder


def is_held(lock: FileLock) -> bool:
    """Return whether a program holds a lock now; also False if the lock file cannot be opened."""
    try:
        with lock.acquire(timeout=0):
            return False
    except Timeout:
        return True
    except OSError:
        return False


class KeptList:
    """A list of JSON objects in a file with a lock, so that several programs can change it.

    `path` is the file's path. `remedy` ends the error message on a damaged file: what to do without a copy.
    """

    def __init__(
        self, folder: Path, name: str, remedy: str = message("remove it and make new tokens")
    ) -> None:
        self.path, self._remedy = folder / name, remedy
        self._lock = FileLock(folder / f"{name}.lock", mode=0o600)
        self._stamp: tuple[int, int, int] | None = None
        self._rows: list[dict[str, Any]] = []

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows, cached until the file changes. Raises `RecordError` for a damaged file."""
        try:
            found = self.path.stat()
            stamp = (found.st_mtime_ns, found.st_size, found.st_ino)
            if stamp != self._stamp:
                rows = from_text(read_regular(self.path))
                if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                    raise ValueError
                self._rows, self._stamp = rows, stamp
        except FileNotFoundError:
            self._rows, self._stamp = [], None
        except (OSError, ValueError) as error:
            raise RecordError(
                f"{self.path}: cannot be read; put a copy in its place, or {self._remedy}"
            ) from error
        return list(self._rows)

    def put_aside(self, now: datetime, check: Callable[[list[dict[str, Any]]], object]) -> None:
        """Rename the file if reading it or `check(rows)` raises `RecordError`. Raises `OSError`."""
        with self._lock:
            try:
                check(self.rows())
            except RecordError:
                self.path.rename(f"{self.path}.damaged-{now:%Y%m%d-%H%M%S}")

    @contextmanager
    def changed(self) -> Iterator[list[dict[str, Any]]]:
        """Yield the rows to change in place, then write them. Raises `RecordError` if this fails."""
        try:
            with self._lock:
                rows = self.rows()
                before = json.dumps(rows)
                yield rows
                if json.dumps(rows) != before:
                    write_whole(self.path, to_text(rows))
                    self.path.chmod(0o600)
        except OSError as error:
            raise RecordError(
                f"{self.path}: cannot be written ({error.strerror}); free disk space or check permissions"
            ) from error


TOKENS: Final = "tokens.json"
LINKS: Final = "links.json"
SESSIONS: Final = "sessions.json"
LONGEST_SESSION: Final = timedelta(days=7)
LONGEST_LINK: Final = timedelta(minutes=30)
MOST_SESSIONS: Final = 20
"""Largest number of sessions of one person; a new session ends the oldest."""
MOST_LINKS: Final = 50


class Access:
    """The tokens, links and sessions of a panel; a laboratory's register of persons replaces the tokens."""

    def __init__(
        self, folder: Path, now: Callable[[], datetime] = utc_now, laboratory: Path | None = None
    ) -> None:
        private_folder(folder)
        self._laboratory = laboratory_known(laboratory)
        self._tokens = KeptList(folder, TOKENS)
        self._links = KeptList(folder, LINKS, message("remove it and make a new link"))
        self._sessions = KeptList(folder, SESSIONS, message("remove it and sign in again"))
        self._now = now

    @property
    def persons(self) -> Persons | None:
        """The laboratory's register of persons; None if there is none. Raises `Refused` if it is damaged."""
        return persons_of(self._laboratory)

    def _refuse_own_tokens(self, command: str) -> None:
        if (register := self.persons) is not None:
            raise RecordError(f"persons and tokens are in {register.folder}; use 'bench persons {command}'")

    # --- tokens -------------------------------------------------------------------------------------

    def new_token(self, name: str, role: Role) -> str:
        """Return a new token. Raises `RecordError` if `name` has one, or if a register of persons exists."""
        self._refuse_own_tokens("change NAME --token")
        name = checked_name(name)
        token = secrets.token_urlsafe(32)
        with self._tokens.changed() as rows:
            if any(row["name"] == name for row in rows):
                whose = f"{as_typed(name)}{runs_to_type(self._tokens.path.parent.parent)}"
                raise RecordError(f"{name}: already has a token; use 'bench panel revoke {whose}' first")
            rows.append(
                {"name": name, "role": role.value, "sha256": _hash(token), "made": self._now().isoformat()}
            )
        return token

    def tokens(self) -> list[dict[str, Any]]:
        """Return `name`, `role` and `made` (time of creation) of each token."""
        if (register := self.persons) is not None:
            return [
                {"name": one.name, "role": role_of(one).value, "made": one.since}
                for one in register.everyone.values()
                if one.token and not one.ended
            ]
        return [{key: row[key] for key in ("name", "role", "made")} for row in self._tokens.rows()]

    def revoke(self, name: str) -> None:
        """Delete a person's token, and end its sessions.

        Raises `RecordError` if the person has no token, or if a register of persons replaces the tokens.
        """
        self._refuse_own_tokens("end NAME")
        with self._tokens.changed() as rows:
            kept = [row for row in rows if row["name"] != name]
            if len(kept) == len(rows):
                if not rows:
                    raise RecordError(f"{name}: has no token, and nobody else has one")
                there = ", ".join(str(row["name"]) for row in rows)
                raise RecordError(f"{name}: has no token; name one of those who have: {there}")
            rows[:] = kept

    # --- one-time links -----------------------------------------------------------------------------

    def new_link(self, name: str) -> str:
        """Return the secret of a new link, with which an operator can sign in once within half an hour.

        If the laboratory has a register of persons, a name without the right to operate raises `Refused`.
        """
        if (register := self.persons) is not None:
            register.chosen(name, Right.OPERATE, "a link for")
        link = secrets.token_urlsafe(32)
        with self._links.changed() as rows:
            rows.append({"name": name, "sha256": _hash(link), "made": self._now().isoformat()})
            rows[:] = [row for row in rows if not self._older(row, LONGEST_LINK)][-MOST_LINKS:]
        return link

    def sign_in_by_link(self, link: str) -> Person | None:
        """Return the person whom a link's secret signs in; None if it is used, expired or unknown."""
        digest = _hash(link)
        # checked before the file is locked, so that a stranger's guesses make nobody wait
        if not any(row["sha256"] == digest for row in self._links.rows()):
            return None
        with self._links.changed() as rows:
            found = [row for row in rows if row["sha256"] == digest and not self._older(row, LONGEST_LINK)]
            rows[:] = [row for row in rows if row["sha256"] != digest]
        if not found:
            return None
        new = self._new_session(str(found[0]["name"]), Role.OPERATOR, "")
        return self.person(new.secret)

    # --- sessions -----------------------------------------------------------------------------------

    def sign_in_by_token(self, token: str) -> Person | None:
        """Return the person whom a token signs in; None if the token is unknown."""
        if (register := self.persons) is not None:
            found = register.with_token(token)
            return None if found is None else self._new_session(found.name, role_of(found), found.token)
        digest = _hash(token)
        for row in self._tokens.rows():
            if secrets.compare_digest(str(row["sha256"]), digest):
                return self._new_session(str(row["name"]), Role(row["role"]), digest)
        return None

    def _new_session(self, name: str, role: Role, token: str) -> Person:
        secret = secrets.token_urlsafe(32)
        row = {
            "name": name,
            "role": role.value,
            "sha256": _hash(secret),
            "token": token,
            "made": self._now().isoformat(),
        }
        with self._sessions.changed() as rows:
            kept = [row for row in rows if not self._older(row, LONGEST_SESSION)]
            own = [row for row in kept if (row["name"], row["token"]) == (name, token)]
            for oldest in own[: max(0, len(own) + 1 - MOST_SESSIONS)]:
                kept.remove(oldest)
            rows[:] = [*kept, row]
        return Person(name, role, secret)

    def person(self, secret: str) -> Person | None:
        """Return the person of the session with this secret; None if it is unknown, expired or revoked."""
        if not secret:
            return None
        digest = _hash(secret)
        for row in self._sessions.rows():
            if row["sha256"] == digest and not self._older(row, LONGEST_SESSION):
                return self._of_session(row, secret)
        return None

    def _of_session(self, row: dict[str, Any], secret: str) -> Person | None:
        if (register := self.persons) is not None:
            known = register.everyone.get(str(row["name"]))
            if known is None or known.ended or row["token"] not in {"", known.token}:
                return None
            role = role_of(known)
            return Person(
                known.name, role if row["token"] else min(role, Role.OPERATOR, key=list(Role).index), secret
            )
        if not row["token"]:
            return Person(str(row["name"]), Role(row["role"]), secret)
        for token in self._tokens.rows():
            if token["sha256"] == row["token"]:
                return Person(str(token["name"]), Role(token["role"]), secret)
        return None

    def sign_out(self, secret: str) -> None:
        """End a session."""
        digest = _hash(secret)
        with self._sessions.changed() as rows:
            rows[:] = [row for row in rows if row["sha256"] != digest]

    def _older(self, row: dict[str, Any], than: timedelta) -> bool:
        return self._now() - datetime.fromisoformat(str(row["made"])) > than


def role_of(person: laboratory.Person) -> Role:
    """Return the role in the panel that follows from the rights of a person of the laboratory."""
    if Right.SUPERVISE in person.may:
        return Role.SUPERVISOR
    return Role.OPERATOR if Right.OPERATE in person.may else Role.VIEWER


def _hash(secret: str) -> str:
    """Return the SHA-256 of a secret, whose 256 random bits need no slow password hash."""
    return sha256(secret.encode(errors="replace")).hexdigest()
