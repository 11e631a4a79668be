"""Functions that all campaigns share: command line, processes, resuming, shares with intervals, tables, exit.

A campaign itself defines its cases, how one is carried out, and what is counted.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import io
import json
import multiprocessing
import os
import resource
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn, TextIO, TypeVar

# the matrices are small: threads would slow each other down, and change the last digits
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np

from bench.base.arrays import Floats, Mask
from bench.model.geometry import COEFFICIENTS

ROOT: Final = Path(__file__).resolve().parents[1]
PROGRAM: Final = (sys.executable, "-c", "from bench.cli.program import main; main()")

Row = Sequence[object]
"""A row of a table."""
Task = TypeVar("Task")
Result = TypeVar("Result")


# --- the command line ---------------------------------------------------------------------------------


def arguments(doc: str | None, given: Sequence[str] | None = None, /, **options: Any) -> argparse.Namespace:
    """Read the command line of a campaign, whose help is its docstring.

    An option is described by its default: False means a flag, a list an option with several values, a type an
    option whose default is None. A pair is a default and a help text. A dictionary goes to argparse unchanged; with
    the key "positional", it describes an argument that is no option. `--jobs` is another name of `--workers`.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in options.items():
        words = default if isinstance(default, dict) else _option(default)
        if words.pop("positional", False):
            parser.add_argument(name, **words)
            continue
        flags = [f"--{name.replace('_', '-')}", *(["--jobs"] if name == "workers" else [])]
        parser.add_argument(*flags, **words)
    return parser.parse_args(given)


def _option(default: Any) -> dict[str, Any]:
    if isinstance(default, tuple):
        return {**_option(default[0]), "help": default[1]}
    if default is False:
        return {"action": "store_true"}
    if isinstance(default, list):
        return {"nargs": "+", "type": type(default[0]), "default": default}
    if isinstance(default, type):
        return {"type": default}
    return {"type": type(default), "default": default}


def refuse(why: str) -> NoReturn:
    """End the program with status 2 and the reason, because of wrong arguments."""
    print(why, file=sys.stderr)
    raise SystemExit(2)


def finish(broken: Sequence[str], holds: str = "every promise holds") -> int:
    """Print the broken promises, or the sentence `holds` if there are none; return the exit status."""
    print("\n".join(["broken:", *broken]) if broken else holds)
    return 1 if broken else 0


# --- processes ----------------------------------------------------------------------------------------


def spread(
    work: Callable[[Task], Result], tasks: Iterable[Task], workers: int, chunk: int = 4
) -> Iterator[Result]:
    """Yield the result of each task in order, computed in `workers` processes (1: in this one).

    The processes are fresh interpreters, because a fork would copy the threads of a linear algebra library.
    """
    if workers == 1:
        yield from map(work, tasks)
        return
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, tasks, chunksize=chunk)


def parts_of(work: Callable[[range], Result], count: int, workers: int, size: int = 100) -> list[Result]:
    """Return the results of `work` on `count` numbered runs, in chunks; a run depends only on its number."""
    chunks = [range(first, min(first + size, count)) for first in range(0, count, size)]
    return list(spread(work, chunks, workers, 1))


class Cost(NamedTuple):
    """The result of work in a separate process, and its cost: CPU time (s), wall time (s), memory (MB)."""

    result: Any
    cpu_s: float
    wall_s: float
    peak_mb: float


def cost_of(work: Callable[..., Any], *given: Any) -> Cost:
    """Carry out work in a fresh process. CPU time and memory are those of the whole process."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_measured, work, *given).result()


def _measured(work: Callable[..., Any], *given: Any) -> Cost:
    begun = time.perf_counter()
    result = work(*given)
    wall_s = time.perf_counter() - begun
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu_s = sum(one.ru_utime + one.ru_stime for one in used)
    return Cost(result, cpu_s, wall_s, max(one.ru_maxrss for one in used) / 1024)


class Said(NamedTuple):
    """The outcome of a command: its status, its output, and its duration, s."""

    status: int
    out: str
    err: str = ""
    seconds: float = 0.0

    @property
    def text(self) -> str:
        """The whole output of the command."""
        return self.out + self.err


def command(*words: object, stdin: str | TextIO = "") -> Said:
    """Carry out a command of the program in this process; `stdin` is typed text, or the keyboard itself."""
    from bench.cli.app import main

    out, err, before = io.StringIO(), io.StringIO(), sys.stdin
    begun, status = time.monotonic(), 0
    sys.stdin = io.StringIO(stdin) if isinstance(stdin, str) else stdin
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main([str(word) for word in words])
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 2
    finally:
        sys.stdin = before
    return Said(status, out.getvalue(), err.getvalue(), time.monotonic() - begun)


def done(*words: object) -> None:
    """Carry out a command of the program; end the campaign if it fails."""
    said = command(*words)
    if said.status == 2:
        raise SystemExit(f"bench {' '.join(map(str, words))}: {said.err}")


# --- a file to resume from ----------------------------------------------------------------------------


class Kept:
    """Results in a file by key, appended one by one, so that an interrupted campaign can be continued.

    A line is compressed JSON as text. A kill may cut off the last line, whose result is then computed again. The
    first line states what the results belong to, such as seed and program, so that results of different ones are
    never mixed.
    """

    def __init__(self, path: Path, head: Mapping[str, object]) -> None:
        """Open or create a file. Raises `ValueError` if its first line differs, or if it is no such file."""
        self._path, self._start = path, time.perf_counter()
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1] if text else _packed(head)
        try:
            lines = [json.loads(zlib.decompress(base64.b64decode(line))) for line in whole.splitlines()]
            other = [name for name in head if lines[0][name] != head[name]]
        except (ValueError, zlib.error, LookupError, TypeError) as error:
            raise ValueError(f"{path}: holds no results of a campaign; name another file") from error
        if other:
            raise ValueError(
                f"{path}: its results are of another {other[0]}; name another file, or remove it"
            )
        if whole != text:
            path.write_bytes(whole)
        self._done = {tuple(line["key"]): line["result"] for line in lines[1:]}
        ended = {line["call"]: line["elapsed_s"] for line in lines[1:]}
        self._before_s, self._call = sum(ended.values()), len(ended)

    @property
    def seconds(self) -> float:
        """The total duration of the campaign so far, over all its continuations, s."""
        return float(self._before_s) + time.perf_counter() - self._start

    def get(self, *key: object) -> Any:
        """Return the result of a key; None if it is still missing."""
        return self._done.get(key)

    def keep(self, result: object, *key: object) -> None:
        """Append a result."""
        elapsed_s = round(time.perf_counter() - self._start, 1)
        line = {"key": key, "result": result, "call": self._call, "elapsed_s": elapsed_s}
        with self._path.open("ab") as file:
            file.write(_packed(line))


def _packed(line: object) -> bytes:
    return base64.b64encode(zlib.compress(json.dumps(line).encode())) + b"\n"


# --- shares ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """A count out of a total, with its Wilson 95 % interval."""

    successes: int
    of: int

    @classmethod
    def true(cls, mask: Mask) -> Share:
        """Return the share of true elements in a mask."""
        return cls(int(np.sum(mask)), int(np.size(mask)))

    @property
    def part(self) -> float:
        """The share itself; NaN for a total of zero."""
        return self.successes / self.of if self.of else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end of the interval; 0 and 1 for a total of zero."""
        if not self.of:
            return 0.0, 1.0
        from scipy.stats import binomtest  # scipy takes long to import, and memory; only shares need it

        ci = binomtest(self.successes, self.of).proportion_ci(confidence_level=0.95, method="wilson")
        return float(ci.low), float(ci.high)

    def __str__(self) -> str:
        if not self.of:
            return "–"
        low, high = self.interval
        return f"{self.part:.3f} ({self.successes}/{self.of}; {low:.3f}–{high:.3f})"

    @property
    def percent(self) -> str:
        """The share and its interval in per cent."""
        low, high = self.interval
        return f"{100 * self.part:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def shares(marks: Iterable[Mapping[str, bool | None]]) -> dict[str, Share]:
    """Return for each column the share of marks that are right; a mark of None does not count."""
    columns: dict[str, list[bool]] = {}
    for name, value in (pair for one in marks for pair in one.items()):
        columns.setdefault(name, []).extend([] if value is None else [bool(value)])
    return {name: Share(sum(values), len(values)) for name, values in columns.items()}


def rms(z: Floats, axis: int | None = 0) -> Any:
    """Return the root mean square, by default of each column."""
    return np.sqrt(np.mean(np.square(z), axis=axis))


def rms_told(z: Floats, by_run: bool = False) -> str:
    """Return the rms with its standard error, as text.

    The error follows from the scatter of the squares or, with `by_run`, of their means by run.
    """
    squares = np.mean(z**2, axis=1) if by_run else z.ravel() ** 2
    size = float(np.sqrt(squares.mean()))
    return f"{size:.3f} ± {float(squares.std(ddof=1)) / np.sqrt(len(squares)) / (2 * size):.3f}"


def show_by_coefficient(rows: Mapping[str, Floats]) -> None:
    """Print a line for each name: its twelve numbers, one per coefficient."""
    for name, values in rows.items():
        print(f"  {name:14}" + " ".join(f"{value:6.3f}" for value in values))


def outside(what: str, values: Floats, low: float, high: float = np.inf) -> list[str]:
    """Return sentences on the coefficients whose value is outside the bounds."""
    pairs = zip(COEFFICIENTS, values, strict=True)
    return [f"{what} of {name} is {value:.3f}" for name, value in pairs if value < low or value > high]


def markdown(heads: Row, rows: Iterable[Row]) -> Iterator[str]:
    """Yield the lines of a Markdown table as the rows arrive."""
    yield f"| {' | '.join(map(str, heads))} |"
    yield f"|{'---|' * len(heads)}"
    for cells in rows:
        yield f"| {' | '.join(map(str, cells))} |"


def amiss(found: Sequence[str], word: str = "VIOLATION", most: int | None = None) -> int:
    """Print a line for each fault; return the exit status."""
    for text in found[:most]:
        print(f"{word} {text}")
    return 1 if found else 0
