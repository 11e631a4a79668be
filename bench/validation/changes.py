"""Checks that name each change since the accepted validation; a person may accept a change with a reason."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from bench.base.files import read_given, read_json
from bench.base.yaml_files import sha256_of_file
from bench.run.seal import is_signed, read_public_key
from bench.services.validated import fingerprint
from bench.validation.machine import description
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter

check = partial(enter, family="changes since the accepted validation", change=True)

_NOTHING = "there is no accepted validation to compare with"
_SHOWN = 5


def compared(now: Mapping[str, Any], before: Mapping[str, Any]) -> Finding:
    """Return the finding on two mappings that must be equal; it names changed, added and removed keys."""
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


@check("release", "7.11.2", "as released", change=False)
def release(context: Context) -> Iterator[Finding]:
    """Compare the program and its packages with the manifest of a release, and verify its signature."""
    if context.release is None:
        yield Finding(True, "no manifest was given")
        return
    content = read_given(context.release)
    if context.release_key is not None:
        signature = base64.b64decode(read_given(context.release.with_name(context.release.name + ".sig")))
        good = is_signed(read_public_key(context.release_key), signature, content)
        said = "signed with the given key" if good else "not signed with the given key, or changed since"
        yield Finding(good, said, of="signature", where=str(context.release))
    manifest, here = read_json(content), fingerprint()
    yield replace(compared(here.files, manifest["program"]), of="program files")
    versions = {name: one.version for name, one in here.packages.items()}
    stated = {name: version for name, version in manifest["packages"].items() if name in versions}
    yield replace(compared(versions, stated), of="packages")
