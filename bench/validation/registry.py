"""The table of checks: a check is one function with its name, clause, expectation and source.

    @check("NIST StRD", "7.11.2", "as many digits as stated", place="bench/calibration/gls.py")
    def regressions(context: Context) -> Iterator[Finding]:
        \"\"\"Fit certified regressions with the estimator's solver.\"\"\"
        yield Finding(digits >= 9, f"{digits:.1f} digits", of="Norris")

A check returns one finding, or yields several. The first line of its docstring says what it does. An
exception gives a failed finding, with the line of the program's own code that raised it.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from bench.base.computing import tracked
from bench.config.bench_file.file import BenchFile, load_bench
from bench.results.registers import ValidationCheck
from bench.services.errors import sentence
from bench.services.validated import OURS, ROOT
from drivers.clock import SystemClock

REFERENCE: Final = Path(__file__).with_name("data")
"""The folder of reference data."""

_NOTHING: Final = "there is no accepted validation to compare with"


@dataclass(frozen=True)
class Finding:
    """The outcome of a check for one part: whether it passed, what was found, and the name of the part (`of`).

    `where` is the place of a failure. `expected` replaces, for this part, the expectation of the check.
    """

    passed: bool
    found: str
    of: str = ""
    where: str = ""
    expected: str = ""


@dataclass
class Context:
    """The context of checks: the bench file, a scratch folder, and the folders that the installation writes.

    `accepted` is the result of the last accepted validation as JSON, empty if there is none. `release` is the
    manifest of a release (None if none was given), `release_key` the public key of its signer.
    """

    bench_path: Path
    scratch: Path
    quick: bool = False
    accepted: dict[str, Any] = field(default_factory=dict)
    folders: tuple[Path, ...] = ()
    release: Path | None = None
    release_key: Path | None = None
    shared: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def bench(self) -> BenchFile:
        """The bench file, loaded. Raises `FileMistakes`."""
        return load_bench(self.bench_path)


Act = Callable[[Context], Finding | Iterable[Finding]]


@dataclass(frozen=True)
class Check:
    """A check: its family, clause of ISO/IEC 17025:2017, expectation, and the function that carries it out.

    `place` is the code that the check tests. `p_false` is an upper bound of the probability that a correct
    program fails with other random numbers. With `change`, a failure is a change since the accepted validation,
    which a person may accept.
    """

    name: str
    family: str
    clause: str
    expected: str
    act: Act
    place: str = ""
    source: str = ""
    p_false: float = 0.0
    change: bool = False

    @property
    def did(self) -> str:
        """What the check does, in a sentence: the first line of its function's docstring."""
        return (self.act.__doc__ or "").strip().splitlines()[0]

    def carried_out(self, context: Context) -> Iterator[ValidationCheck]:
        """Yield a row for each finding; an exception gives a failed row."""
        clock = SystemClock()
        began_s = clock.now_s()
        try:
            found = self.act(context) if context.accepted or not self.change else Finding(True, _NOTHING)
            for one in [found] if isinstance(found, Finding) else found:
                yield self._row(one, clock.now_s() - began_s)
                began_s = clock.now_s()
        except Exception as error:
            where = "; raised in ".join(filter(None, (self.place, raised_at(error))))
            yield self._row(Finding(False, sentence(error), where=where), clock.now_s() - began_s)

    def _row(self, finding: Finding, took_s: float) -> ValidationCheck:
        return ValidationCheck.from_object(
            finding,
            self,
            name=f"{self.name}: {finding.of}" if finding.of else self.name,
            expected=finding.expected or self.expected,
            where="" if finding.passed else finding.where or self.place,
            took_s=round(took_s, 3),
        )


TABLE: Final[list[Check]] = []
"""All checks, in the order in which their modules were imported."""

MODULES: Final = ("reference", "gum", "instruments", "records", "machine")
"""The modules that define checks, in the order of the page."""


def every() -> list[Check]:
    """Return all checks, after importing the modules that define them."""
    places = [import_module(f"bench.validation.{name}").__name__ for name in MODULES]
    return sorted(TABLE, key=lambda one: places.index(one.act.__module__))


def check(name: str, clause: str, expected: str, *, family: str, **more: Any) -> Callable[[Act], Act]:
    """Return a decorator that adds a function to `TABLE` as a check; `more` are further fields of `Check`."""

    def entered(act: Act) -> Act:
        TABLE.append(Check(name, family, clause, expected, act, **more))
        return act

    return entered


def raised_at(error: BaseException) -> str:
    """Return file, line and function of the program's own code where an error was raised; "" for other code."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in OURS:
            ours = path.relative_to(ROOT)
            if ours.parts[:2] != ("bench", "validation"):
                return f"{ours.as_posix()}, line {frame.lineno} ({frame.name})"
    return ""


def carry_out(context: Context, checks: Iterable[Check]) -> list[ValidationCheck]:
    """Carry out checks, with reports of progress; return a row for each finding."""
    rows: list[ValidationCheck] = []
    for one in tracked(list(checks), "checks"):
        rows += one.carried_out(context)
    return rows
