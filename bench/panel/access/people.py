"""Who is signed in, and what a role may."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """What a person may: look and stop; move and answer as well; take control by force as well."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    SUPERVISOR = "supervisor"

    def includes(self, other: Role) -> bool:
        """Whether it may all that another role may."""
        order = list(Role)
        return order.index(self) >= order.index(other)


@dataclass(frozen=True)
class Person:
    """Somebody signed in: name, role, and the secret of the session, which only the browser has."""

    name: str
    role: Role
    secret: str = ""

    @property
    def csrf(self) -> str:
        """What every form of this session carries, and no other page can know."""
        return hashlib.sha256(f"form:{self.secret}".encode()).hexdigest()[:32]


class Refusal(Exception):
    """A request that is refused: HTTP status and one sentence."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status, self.text = status, text
