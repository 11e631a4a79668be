"""Tokens of persons, one-time links, and sessions: of each secret the panel keeps its hash alone."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final

from bench.base.visible import visible
from bench.panel.access.kept import KeptList, private_folder
from bench.panel.access.people import Person, Role
from bench.run.manifest import RecordError
from drivers.clock import utc_now

TOKENS: Final = "tokens.json"
LINKS: Final = "links.json"
SESSIONS: Final = "sessions.json"
LONGEST_SESSION: Final = timedelta(days=7)
LONGEST_LINK: Final = timedelta(minutes=30)
MOST_SESSIONS: Final = 20
"""Sessions of one person; the oldest ends when another begins."""
MOST_LINKS: Final = 50
LONGEST_NAME: Final = 60


class Access:
    """Who may come in. What it knows stands in files of a folder that is its owner's alone."""

    def __init__(self, folder: Path, now: Callable[[], datetime] = utc_now) -> None:
        private_folder(folder)
        self._tokens = KeptList(folder, TOKENS)
        self._links = KeptList(folder, LINKS)
        self._sessions = KeptList(folder, SESSIONS)
        self._now = now

    # --- tokens -------------------------------------------------------------------------------------

    def new_token(self, name: str, role: Role) -> str:
        """Make a person's token and return it, this once. Raises `RecordError` for a name that has one."""
        name = checked_person(name)
        token = secrets.token_urlsafe(32)
        with self._tokens.changed() as rows:
            if any(row["name"] == name for row in rows):
                raise RecordError(f"{name}: has a token already; 'bench panel revoke {name}' first")
            rows.append(
                {"name": name, "role": role.value, "sha256": _hash(token), "made": self._now().isoformat()}
            )
        return token

    def tokens(self) -> list[dict[str, Any]]:
        """Return name, role and time of making of each token."""
        return [{key: row[key] for key in ("name", "role", "made")} for row in self._tokens.rows()]

    def revoke(self, name: str) -> None:
        """Forget a person's token; its sessions end with it. Raises `RecordError` where there is none."""
        with self._tokens.changed() as rows:
            kept = [row for row in rows if row["name"] != name]
            if len(kept) == len(rows):
                there = ", ".join(str(row["name"]) for row in rows) or "none"
                raise RecordError(f"{name}: has no token; there are tokens of: {there}")
            rows[:] = kept

    # --- one-time links -----------------------------------------------------------------------------

    def new_link(self, name: str) -> str:
        """Make the secret of a link that signs an operator in, once, within half an hour."""
        link = secrets.token_urlsafe(32)
        with self._links.changed() as rows:
            rows.append({"name": name, "sha256": _hash(link), "made": self._now().isoformat()})
            rows[:] = [row for row in rows if not self._older(row, LONGEST_LINK)][-MOST_LINKS:]
        return link

    def sign_in_by_link(self, link: str) -> Person | None:
        """Take a link's secret and return who is signed in by it, None where it is used up, too old or none."""
        digest = _hash(link)
        # looked at before the file is locked: what strangers guess must not make anybody wait
        if not any(row["sha256"] == digest for row in self._links.rows()):
            return None
        with self._links.changed() as rows:
            found = [row for row in rows if row["sha256"] == digest and not self._older(row, LONGEST_LINK)]
            rows[:] = [row for row in rows if row["sha256"] != digest]
        if not found:
            return None
        return self._new_session(str(found[0]["name"]), Role.OPERATOR, "")

    # --- sessions -----------------------------------------------------------------------------------

    def sign_in_by_token(self, token: str) -> Person | None:
        """Return who is signed in by a token, None where it is nobody's."""
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
        """Return whose session a cookie's secret is, None where it is none, too old, or its token was revoked."""
        if not secret:
            return None
        digest = _hash(secret)
        for row in self._sessions.rows():
            if row["sha256"] == digest and not self._older(row, LONGEST_SESSION):
                return self._of_session(row, secret)
        return None

    def _of_session(self, row: dict[str, Any], secret: str) -> Person | None:
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


def checked_person(name: str) -> str:
    """Return a person's name. Raises `RecordError` for one that cannot be shown or is too long."""
    name = name.strip()
    if not name or len(name) > LONGEST_NAME or not name.isprintable() or visible(name) != name:
        raise RecordError(
            f"{visible(name)!r}: a name is text that can be printed, of 1 to {LONGEST_NAME} characters"
        )
    return name


def _hash(secret: str) -> str:
    """Return the SHA-256 of a secret: 256 random bits, which no slower hash would guard better."""
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()
