"""Files: non-blocking reads, atomic writes, JSON text, the user's cache folder."""

from __future__ import annotations

import errno
import json
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, NoReturn

from pydantic_core import from_json

from bench.base.languages import message
from bench.base.text import in_json, repeated, shortened, visible

# --- reading ----------------------------------------------------------------------------------------

MEGABYTE: Final = 1_000_000

_KINDS: Final = (
    (stat.S_ISDIR, "this is a folder; name a file in it"),
    (stat.S_ISFIFO, "this is a pipe, not a file"),
    (stat.S_ISSOCK, "this is a socket, not a file"),
    (stat.S_ISCHR, "this is a device, not a file"),
    (stat.S_ISBLK, "this is a device, not a file"),
)
DISK_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of a failed write: the disk is full, or the user's quota is used up."""

_CHUNK: Final = 65_536
_AT_ONCE: Final = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)


def open_regular(path: Path, mode: Literal["rb", "ab"] = "rb") -> BinaryIO:
    """Open a regular file for reading, or for unbuffered appending; never open or wait for a pipe or device.

    Raises `OSError`, whose `strerror` says that the path is a folder, a pipe or the like.
    """
    try:
        if mode == "rb" or path.exists():
            _check(path, path.stat().st_mode)  # before opening: opening a device may have an effect
        file = open(path, mode, buffering=0 if mode == "ab" else -1, opener=_at_once)  # noqa: SIM115
    except ValueError:  # a character that no file name can have
        raise FileNotFoundError(errno.ENOENT, "there is no such file", str(path)) from None
    try:
        _check(path, os.fstat(file.fileno()).st_mode)
    except OSError:
        file.close()
        raise
    return file


def read_regular(path: Path, most_bytes: int | None = None) -> bytes:
    """Return the content of a regular file; never open or wait for a pipe or device.

    Raises `OSError`, whose `strerror` says that the path is a folder, a pipe or the like, or that the file
    has more than `most_bytes` (None: no limit).
    """
    with open_regular(path) as file:
        content = file.read() if most_bytes is None else file.read(most_bytes + 1)
    if most_bytes is not None and len(content) > most_bytes:
        size = f"{most_bytes / MEGABYTE:g} MB"
        raise OSError(errno.EFBIG, f"the file has more than {size}", str(path))
    return content


def read_given(path: Path) -> bytes:
    """Return the content of a path that a person named: a file, the standard input, or a pipe with a writer.

    A pipe can be read only once. Raises `OSError`, whose `strerror` says that the path is a folder or the like, or
    that the pipe has no writer. This function never waits for a writer.
    """
    try:
        about = path.stat()
    except ValueError:  # a character that no file name can have
        raise FileNotFoundError(errno.ENOENT, "there is no such file", str(path)) from None
    if stat.S_ISFIFO(about.st_mode):
        return _from_pipe(path)
    if not _is_standard_input(about):
        _check(path, about.st_mode)
    return path.read_bytes()


def _from_pipe(path: Path) -> bytes:
    descriptor = os.open(path, _AT_ONCE)
    with os.fdopen(descriptor, "rb", buffering=0) as pipe:
        try:
            begun = os.read(descriptor, _CHUNK)
        except BlockingIOError:  # a writer has the pipe open but has not written yet
            begun = None
        if begun == b"":
            raise OSError(errno.EPIPE, "the pipe has no writer", str(path))
        os.set_blocking(descriptor, True)
        return (begun or b"") + pipe.read()


def remedy_for(error: OSError, usual: str) -> str:
    """Return what a person should do after a file could not be read, by default `usual`.

    A pipe without a writer and a file that is too large have their own remedies.
    """
    if error.errno == errno.EPIPE:
        return message("check the command that writes into it, or give a file with its output")
    return message("give a smaller file") if error.errno == errno.EFBIG else usual


def _is_standard_input(about: os.stat_result) -> bool:
    try:
        return os.path.samestat(about, os.fstat(0))
    except OSError:  # the program has no standard input
        return False


def _check(path: Path, mode: int) -> None:
    for is_one, text in _KINDS:
        if is_one(mode):
            kind = IsADirectoryError if is_one is stat.S_ISDIR else OSError
            raise kind(errno.EISDIR if kind is IsADirectoryError else errno.EINVAL, text, str(path))


def cache_folder(part: str) -> Path:
    """Return the user's cache folder for `part` of the program; it may not exist yet."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("triaxial-bench")) / part


def read_json(content: bytes) -> Any:
    """Return the value of JSON text in UTF-8. Raises `ValueError` for invalid JSON, also for NaN."""
    try:
        return from_json(content, allow_inf_nan=False)
    except ValueError:
        return _DECODER.decode(content.decode())  # json accepts more, such as a lone surrogate


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number of JSON")


_DECODER: Final = json.JSONDecoder(parse_constant=_no_number)


# --- JSON text and writing --------------------------------------------------------------------------


def to_text(result: Any, *, only_ascii: bool = False) -> str:
    """Return a result as indented JSON text, with escapes for control and invisible characters.

    With `only_ascii`, all characters outside ASCII are escaped as well. Raises `ValueError` for NaN and infinity.
    """
    return in_json(json.dumps(result, indent=1, ensure_ascii=only_ascii, allow_nan=False)) + "\n"


def from_text(text: str | bytes) -> Any:
    """Return the value of JSON text, strictly by RFC 8259.

    Raises `ValueError` for invalid JSON, `NaN` or `Infinity`, a duplicate key, or excessive nesting.
    """
    try:
        return json.loads(text, parse_constant=_not_finite, object_pairs_hook=_once)
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None


def _not_finite(word: str) -> Any:
    raise ValueError(f"{word} is not a number")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    whole = dict(pairs)
    if len(whole) < len(pairs):
        twice = repeated(name for name, _ in pairs)[0]
        raise ValueError(f"'{shortened(twice)}' appears twice")
    return whole


def write_whole(path: Path, text: str | bytes) -> None:
    """Write a file atomically, also if the power fails. Raises `OSError` that names the path.

    A text is encoded in UTF-8. Links are followed. A device or pipe (`/dev/null`) is written to, not replaced by a
    file.
    """
    content = text.encode() if isinstance(text, str) else text
    try:
        os.fsencode(path)
    except UnicodeEncodeError:  # a lone surrogate, which no file system accepts
        raise OSError(errno.EINVAL, "not a valid file name", visible(str(path))) from None
    try:
        if path.exists() and not path.is_file():
            with _opened_at_once(path) as special:
                special.write(content)
        else:
            _put_in_place(Path(os.path.realpath(path)), content)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _opened_at_once(path: Path) -> BinaryIO:
    """Open a device or pipe for writing. Raises `OSError` for a pipe without a reader; never waits for a reader."""
    try:
        descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise OSError(errno.ENXIO, "the pipe has no reader; start the reader first") from None
        raise
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")


def _put_in_place(path: Path, content: bytes) -> None:
    half = path.with_name(path.name + ".part")
    try:
        write_synced(half, content)  # else the name could reach the disk before the content
        half.replace(path)
    except OSError:
        with suppress(OSError):  # a read-only file system refuses this, too
            half.unlink(missing_ok=True)
        raise


def write_synced(path: Path, content: bytes) -> None:
    """Write a file in place and flush it to the disk, so that its content survives a power failure."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Flush the file names in a folder to the disk on POSIX systems, so that they survive a power failure."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
