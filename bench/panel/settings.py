"""Where a panel listens, which runs it shows, and what it keeps beside them."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Final

STATE: Final = ".panel"
PORT: Final = 8741


@dataclass(frozen=True)
class Settings:
    """A panel over the runs in a folder.

    `address` is the one that a proxy with TLS before it has, such as https://lab; `laboratory` a laboratory file,
    whose register holds the certificates of the runs; `catalogue` the one that its pages on units show, empty for
    none.
    """

    runs: Path
    host: str = "127.0.0.1"
    port: int = PORT
    address: str = ""
    laboratory: Path | None = None
    catalogue: str = ""

    @property
    def loopback(self) -> bool:
        """Whether nobody but this computer can reach it, and no proxy brings others."""
        return not self.address and is_loopback(self.host)

    @property
    def url(self) -> str:
        """The address at which a browser finds it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return self.address or f"http://{host}:{self.port}"

    @property
    def cookie(self) -> str:
        """Name of its cookie: browsers tell two panels of one computer apart by it, as ports do not."""
        return (
            f"bench_panel_{sha256(str(self.runs.resolve()).encode(errors='surrogateescape')).hexdigest()[:8]}"
        )

    def allows_host(self, host: str) -> bool:
        """Whether a request may name this host: on loopback no name that a stranger's server could have."""
        if self.loopback:
            return host in {f"{name}:{self.port}" for name in ("127.0.0.1", "localhost", "[::1]")}
        return bool(host)

    def allows_origin(self, origin: str, host: str) -> bool:
        """Whether a page of this origin may ask for a change: only one of the panel's own."""
        return origin == (self.address or f"http://{host}")


def is_loopback(host: str) -> bool:
    """Whether an address, or `localhost`, is the computer's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
