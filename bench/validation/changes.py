"""Changes since the accepted validation, each named: a person may accept them with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from bench.base.yaml_files import sha256_of_file
from bench.services.validated import fingerprint
from bench.validation.machine import description
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter

check = partial(enter, family="changes since the accepted validation", change=True)

_NOTHING = "there is no accepted validation to compare with"
_SHOWN = 5


def compared(now: Mapping[str, Any], before: Mapping[str, Any]) -> Finding:
    """Return the finding on two mappings that must be equal; it names the changed, added and removed keys."""
    changed = sorted(name for name in now.keys() & before.keys() if now[name] != before[name])
    added, gone = sorted(now.keys() - before.keys()), sorted(before.keys() - now.keys())
    parts = [
        f"{what} {', '.join(names[:_SHOWN])}"
        + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
        for what, names in (("changed:", changed), ("new:", added), ("gone:", gone))
        if names
    ]
    return Finding(not parts, "; ".join(parts) or f"{len(now)} the same", where="; ".join(parts))


@check("program files", "7.11.2", "as accepted")
def program_files(context: Context) -> Finding:
    """Compare the program's own files with those of the accepted validation."""
    if context.accepted is None:
        return Finding(True, _NOTHING)
    return compared(fingerprint().files, context.accepted["program"]["files"])


@check("packages", "7.11.2", "as accepted")
def packages(context: Context) -> Finding:
    """Compare the versions and lists of files of packages, and Python, with the accepted validation."""
    if context.accepted is None:
        return Finding(True, _NOTHING)

    def told(program: Mapping[str, Any]) -> dict[str, Any]:
        return {**program["packages"], "python": program["python"], "platform": program["platform"]}

    return compared(told(fingerprint().to_dict()), told(context.accepted["program"]))


@check("bench file", "6.4.4", "as accepted")
def bench_file(context: Context) -> Finding:
    """Compare the bench file with the bench file of the accepted validation."""
    if context.accepted is None:
        return Finding(True, _NOTHING)
    digest, before = sha256_of_file(context.bench_path), context.accepted["bench"]["sha256"]
    found = f"SHA-256 {digest[:12]}…" + ("" if digest == before else f", accepted was {before[:12]}…")
    return Finding(digest == before, found, where=str(context.bench_path))


@check("machine", "6.4.4", "as accepted")
def machine(context: Context) -> Finding:
    """Compare time zone, locale, encoding and user with the accepted validation of the same computer."""
    if context.accepted is None:
        return Finding(True, _NOTHING)
    now, before = description(), dict(context.accepted["machine"])
    for one in (now, before):
        one.pop("system", None)  # its kernel changes with every update of the system
        # summer time is no change
        one["time zone"] = one.get("time zone", "").partition(" (")[0]
    return compared(now, before)
