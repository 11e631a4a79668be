"""The machine: packages, clock, time zone, locale, disks, permissions; changes since the accepted validation."""

from __future__ import annotations

import base64
import csv
import hashlib
import locale
import os
import platform
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from packaging.requirements import Requirement

from bench.base.files import cache_folder, read_given, read_json, write_whole
from bench.base.languages import message
from bench.base.yaml_files import sha256_of_file
from bench.readings.csv import read_csv
from bench.run.seal import is_signed, read_public_key
from bench.services.errors import sentence
from bench.services.validated import DISTRIBUTION, fingerprint, packages, plug_ins
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter
from drivers.clock import SystemClock, utc_now

check = partial(enter, family=message("machine", "heading"))
compare = partial(enter, family=message("changes since the accepted validation"), change=True)

_FREE_BYTES: Final = 500_000_000
_NOT_BEFORE: Final = datetime(2026, 11, 1, tzinfo=UTC)
"""The program was made after this time, so that an earlier clock is wrong."""


def description() -> dict[str, str]:
    """Return the name and settings that identify this computer."""
    now = utc_now().astimezone()
    return {
        "computer": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "user": "root" if hasattr(os, "geteuid") and os.geteuid() == 0 else os.environ.get("USER", ""),
        "time zone": f"{os.environ.get('TZ') or zone_of_system() or 'UTC'} ({now:%z})",
        "locale": ".".join(filter(None, locale.getlocale())) or "C",
        "encoding": f"{sys.getfilesystemencoding()}, {locale.getpreferredencoding(False)}",
    }


def zone_of_system() -> str:
    """Return the name of the system's time zone; "" if the system does not state it."""
    link = Path("/etc/localtime")
    if link.is_symlink():
        return str(link.resolve()).partition("zoneinfo/")[2]
    return ""


# --- packages ---------------------------------------------------------------------------------------


@check(
    "package files", "7.11.3", "as in the package's list of files", source="RECORD of each installed package"
)
def package_files(context: Context) -> Iterator[Finding]:
    """Hash every installed file of the packages and compare with the list that came with the package."""
    for one in packages():
        wrong, listed = _differing(one)
        if listed == 0 and one.name == DISTRIBUTION:
            words = "runs from a checkout, without such a list: compared with the accepted validation alone"
            yield Finding(True, words, of=one.name, expected="a list of files, or a checkout")
            continue
        words = (
            f"{listed} files"
            if not wrong
            else f"{len(wrong)} of {listed} files differ: {', '.join(wrong[:3])}"
        )
        yield Finding(
            not wrong and listed > 0, words, of=f"{one.name} {one.version}", where=", ".join(wrong[:3])
        )


def _differing(one: metadata.Distribution) -> tuple[list[str], int]:
    """Return the files of a package that are missing or changed, and the number of files with a stated hash."""
    wrong, count = [], 0
    for name, stated, _ in csv.reader((one.read_text("RECORD") or "").splitlines()):
        kind, _, value = stated.partition("=")
        if not value or name.endswith((".pyc", "direct_url.json")) or name.startswith("../"):
            continue  # "../": a script or data outside the package, whose first line may be the installer's
        file = Path(str(one.locate_file(name)))
        if one.name == DISTRIBUTION and file.suffix == ".pth":
            continue
        count += 1
        try:
            digest = hashlib.new(kind, file.read_bytes()).digest()
        except OSError:
            wrong.append(f"{file} (missing; install the package again)")
            continue
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != value:
            wrong.append(str(file))
    if one.name == DISTRIBUTION and not any(
        name.startswith("bench/") for name, *_ in csv.reader((one.read_text("RECORD") or "").splitlines())
    ):
        return wrong, 0
    return wrong, count


@check("package versions", "7.11.2", "within the stated bounds", source="requirements of the program")
def package_versions(context: Context) -> Iterator[Finding]:
    """Compare the versions of the packages with the bounds that the program states."""
    try:
        wanted = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        yield Finding(False, "the program is not installed as a package", where=sys.executable)
        return
    wrong, count = [], 0
    for text in dict.fromkeys(wanted):
        stated = Requirement(text)
        try:
            version = metadata.version(stated.name)
        except metadata.PackageNotFoundError:
            if stated.marker is None or stated.marker.evaluate():
                wrong.append(f"{stated.name} is not installed; install it with pip")
            continue
        count += 1
        if not stated.specifier.contains(version, prereleases=True):
            wrong.append(
                f"{stated.name} {version} is not {stated.specifier}; install such a version with pip"
            )
    yield Finding(not wrong, "; ".join(wrong) or f"{count} packages", where="; ".join(wrong))


# --- time -------------------------------------------------------------------------------------------


@check("clock", "7.5.1", "")
def clock(context: Context) -> Iterator[Finding]:
    """Compare the clock with the newest files of program and records, and its rate with the monotonic clock."""
    now = utc_now()
    yield Finding(
        now >= _NOT_BEFORE, f"{now:%Y-%m-%d %H:%M} UTC", of="not before the program", where="the computer's clock",
        expected=f"after {_NOT_BEFORE:%Y-%m-%d}",
    )  # fmt: skip
    newest, file = _newest(context)
    late_s = newest - now.timestamp()
    yield Finding(
        late_s < 120.0, f"the newest file is {abs(late_s) / 60:.0f} min {'ahead' if late_s > 0 else 'old'}",
        of="not before its files", where=f"the computer's clock; {file}", expected="no file from the future",
    )  # fmt: skip
    steady, civil, began_s = SystemClock(), time.time(), time.monotonic()
    steady.sleep(0.2)
    off = (time.time() - civil) - (time.monotonic() - began_s)
    yield Finding(
        abs(off) < 0.05, f"{off * 1e3:+.1f} ms in 0.2 s", of="steady", where="the computer's clock",
        expected="within 50 ms of the monotonic clock",
    )  # fmt: skip


def _newest(context: Context) -> tuple[float, str]:
    """Return time (s) and path of the newest record in the folders or, if there is no record, of a new file."""
    probe = context.scratch / "now"
    probe.write_bytes(b"")
    found = [(probe.stat().st_mtime, str(probe))]
    for folder in context.folders:
        found += [(path.stat().st_mtime, str(path)) for path in folder.glob("*/*.jsonl")]
        found += [(path.stat().st_mtime, str(path)) for path in folder.glob("*.jsonl")]
    return max(found)


@check("time zone", "7.5.1", "")
def zone(context: Context) -> Iterator[Finding]:
    """Compare the UTC offset that the program writes with the rules of the zone, and read a written time back."""
    name = os.environ.get("TZ", "").removeprefix(":") or zone_of_system()
    now = utc_now()
    offset = now.astimezone().utcoffset() or timedelta(0)
    where = f"TZ={os.environ['TZ']}" if os.environ.get("TZ") else "the system's time zone"
    if name and not re.fullmatch(r"[A-Z]{3,4}(?:[+-]?\d.*)?|.*,.*", name):
        try:
            meant = now.astimezone(ZoneInfo(name)).utcoffset()
            words = f"the system's offset from UTC is {offset}, the rules of {name} give {meant}"
            yield Finding(offset == meant, words, of="offset", where=where, expected="the same offset")
        except (ZoneInfoNotFoundError, ValueError, OSError):
            yield Finding(False, f"no zone is called {name}: times are UTC under another name", of="offset",
                          where=where, expected="a zone of the IANA data base")  # fmt: skip
    else:
        yield Finding(
            True, f"{offset} from UTC ({name or 'UTC'})", of="offset", expected="stated with each time"
        )
    written = now.astimezone().isoformat()
    yield Finding(
        datetime.fromisoformat(written) == now, written, of="written and read", where="datetime",
        expected="the same instant",
    )  # fmt: skip


# --- text and numbers -------------------------------------------------------------------------------

_TABLE: Final = """\
installation,pass,point,angle_deg,ux_v,uy_v,uz_v,note
1,1,1,0,0.1,-0.2,-2.5,µ ″
1,1,2,45.5,1e-3,-0.2,-2.5,α
"""


@check("locale", "7.11.6", "the same numbers and text as everywhere", place="the locale of the user")
def numbers_and_text(context: Context) -> Iterator[Finding]:
    """Write and read numbers and Greek letters under the user's locale, and a readings file."""
    was = locale.setlocale(locale.LC_ALL)
    try:
        try:
            name = locale.setlocale(locale.LC_ALL, "")
        except locale.Error:
            wanted = os.environ.get("LC_ALL") or os.environ.get("LC_NUMERIC") or os.environ.get("LANG", "")
            yield Finding(
                False, f"no locale is called {wanted}", of="name", where="LC_ALL or LANG", expected="known"
            )
            name = "C"
        same = f"{1234.5:.2f}" == "1234.50" and float("1234.5") == 1234.5 and sorted(["b", "A"]) == ["A", "b"]
        yield Finding(same, f"{1234.5:.2f} under {name}", of="numbers", expected="1234.50")
        file = context.scratch / "µ-readings.csv"
        write_whole(file, _TABLE)
        signal = read_csv(file, ["1", "2"]).signal.ravel().tolist()
        good = signal == [0.1, -0.2, -2.5, 1e-3, -0.2, -2.5]
        yield Finding(good, f"{len(signal)} signals", of="a readings file", expected="6 signals, as written")
    finally:
        locale.setlocale(locale.LC_ALL, was)
    good = sys.getfilesystemencoding().lower() in {"utf-8", "utf8"}
    yield Finding(
        good, sys.getfilesystemencoding(), of="names of files", where="LC_ALL or PYTHONUTF8", expected="utf-8"
    )


# --- disks ------------------------------------------------------------------------------------------


@check("disk", "7.11.3", "")
def disks(context: Context) -> Iterator[Finding]:
    """Write, replace, flush and lock a file in each folder that the program writes, and query the free space."""
    places = [*context.folders, Path(tempfile.gettempdir()), cache_folder("validation")]
    for folder in dict.fromkeys(place.absolute() for place in places):
        there = next(one for one in (folder, *folder.parents) if one.exists())
        wrong = _unwritable(there)
        yield Finding(not wrong, wrong or "written, replaced, flushed, locked", of=str(folder), where=str(there),
                      expected="can be written")  # fmt: skip
        free = shutil.disk_usage(there).free
        yield Finding(free > _FREE_BYTES, f"{free / 1e9:.1f} GB free", of=f"space in {folder}", where=str(there),
                      expected=f"> {_FREE_BYTES / 1e9:g} GB")  # fmt: skip


_SECOND: Final = """
import sys
from filelock import FileLock, Timeout
try:
    FileLock(sys.argv[1], timeout=0).acquire()
except Timeout:
    sys.exit(7)
"""


def _unwritable(folder: Path) -> str:
    """Return why a record would not be safe in a folder; "" if it would be."""
    from filelock import FileLock

    try:
        with tempfile.TemporaryDirectory(prefix=".bench-validate-", dir=folder) as made:
            file = Path(made) / "probe"
            for content in (b"first", b"second"):
                write_whole(file, content)
            with file.open("ab") as stream:
                stream.write(b" third")
                stream.flush()
                os.fsync(stream.fileno())
            if file.read_bytes() != b"second third":
                return "what was written is not what is read"
            lock = Path(made) / "lock"
            with FileLock(lock):
                second = [sys.executable, "-c", _SECOND, str(lock)]
                taken = subprocess.run(second, check=False, timeout=60)  # noqa: S603 - our own text
            if taken.returncode != 7:
                return "a lock does not keep a second program out"
    except (OSError, subprocess.SubprocessError) as error:
        return sentence(error) if isinstance(error, OSError) else str(error)
    return ""


@check("permissions", "7.11.3", "")
def permissions(context: Context) -> Iterator[Finding]:
    """Check whether other users may write the program, the bench file, the runs or the register."""
    if os.name != "posix":
        yield Finding(
            True, "not looked at: this system has other permissions", expected="only the user writes"
        )
        return
    program = Path(__file__).parents[1]
    for what, place in (
        ("program", program), ("bench file", context.bench_path), *(("folder", one) for one in context.folders),
    ):  # fmt: skip
        if place.exists():
            mode = stat.S_IMODE(place.stat().st_mode)
            yield Finding(
                not mode & stat.S_IWOTH, f"mode {mode:o}", of=f"{what} {place}", where=str(place),
                expected="not writable by everybody",
            )  # fmt: skip


# --- changes since the accepted validation; a person may accept one with a reason -----------------------

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


@compare("program files", "7.11.2", "as accepted")
def program_as_accepted(context: Context) -> Finding:
    """Compare the program's own files with those of the accepted validation."""
    return compared(fingerprint().files, context.accepted["program"]["files"])


@compare("packages", "7.11.2", "as accepted")
def packages_as_accepted(context: Context) -> Finding:
    """Compare the versions and lists of files of packages, and Python, with the accepted validation."""

    def told(program: Mapping[str, Any]) -> dict[str, Any]:
        return {**program["packages"], "python": program["python"], "platform": program["platform"]}

    return compared(told(fingerprint().to_dict()), told(context.accepted["program"]))


@compare("bench file", "6.4.4", "as accepted")
def bench_as_accepted(context: Context) -> Finding:
    """Compare the bench file with the bench file of the accepted validation."""
    digest, before = sha256_of_file(context.bench_path), context.accepted["bench"]["sha256"]
    found = f"SHA-256 {digest[:12]}…" + ("" if digest == before else f", accepted was {before[:12]}…")
    return Finding(digest == before, found, where=str(context.bench_path))


@compare("own drivers and effects", "7.11.2", "as accepted")
def plug_ins_as_accepted(context: Context) -> Finding:
    """Compare the laboratory's own drivers and effects with the accepted validation."""
    return compared(plug_ins(context.bench), context.accepted["bench"].get("plug_ins", {}))


@compare("machine", "6.4.4", "as accepted")
def machine_as_accepted(context: Context) -> Finding:
    """Compare time zone, locale, encoding and user with the accepted validation of the same computer."""
    now, before = description(), dict(context.accepted["machine"])
    for one in (now, before):
        one.pop("system", None)  # its kernel changes with every update of the system
        # summer time is no change
        one["time zone"] = one.get("time zone", "").partition(" (")[0]
    return compared(now, before)


@compare("release", "7.11.2", "as released", change=False)
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
