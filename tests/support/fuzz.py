"""Invalid and unusual inputs: the program accepts each, or refuses it in a sentence.

Inputs are readings, bench files, procedures, model files, results, records, names, answers at prompts, extreme
values, pipes for files, damaged catalogues, and calls from Python. Each is made from the seed and its number
(`fuzz_inputs`, `fuzz_edges`).

Promised: no traceback, no message of an unforeseen error, no control character for a terminal, one of the
documented statuses, and no acceptance of what must be refused (signals that are not finite, an impossible
covariance, a wrong unit, a repeated key, a changed record, …).
"""

import contextlib
import io
import json
import math
import os
import random
import re
import shutil
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.text import visible
from benchmarks.campaign import ROOT
from tests.support.fuzz_edges import MADE_AT_EDGES, python_trial
from tests.support.fuzz_inputs import MADE, WEIRD, Case, spoilt_bytes, spoilt_tree, weird

MAKERS: Final = {**MADE, **MADE_AT_EDGES}
KINDS: Final = (*MAKERS, "answers", "python")
LONGEST_LINE: Final = 6000
"""Largest length of a line on standard error, in characters: a message must not quote long values in full."""

_UNFORESEEN: Final = re.compile(
    r"^(bench: |note: )?unexpected|mistake of the program|Traceback \(most recent", re.MULTILINE
)


@dataclass(frozen=True)
class Violation:
    """A violation: kind and number of the input, the broken promise, and what happened."""

    kind: str
    number: int
    what: str
    how: str


def generator(kind: str, seed: int, number: int) -> random.Random:
    """Return the random number generator of an input."""
    return random.Random(f"{seed}/{kind}/{number}")  # noqa: S311 - nothing secret


def tried(kind: str, seed: int, number: int) -> list[Violation]:
    """Make an input and try it in the current folder, which must be empty; return the violations."""
    rng = generator(kind, seed, number)
    try:
        others = {"answers": _answers, "python": python_trial}
        broken = others[kind](rng) if kind in others else _commands(kind, rng)
    except Exception:
        broken = [("traceback", traceback.format_exc())]
    return [Violation(kind, number, what, how) for what, how in broken]


# --- commands -----------------------------------------------------------------------------------------


def _commands(kind: str, rng: random.Random) -> list[tuple[str, str]]:
    case = MAKERS[kind](rng)
    for name in case.pipes:
        os.mkfifo(name)
    for name, content in case.files.items():
        Path(name).write_bytes(content)
    if case.record:
        case.refuse = spoil_record(rng, Path("runs/run"))
    broken = []
    for number, command in enumerate(case.commands):
        status, out, err = called(command, case.stdin)
        broken += [
            (what, f"bench {' '.join(map(repr, command))}\n{how[-1500:]}")
            for what, how in judged(case, status, out, err, number)
        ]
    return broken


def judged(case: Case, status: object, out: str, err: str, number: int) -> Iterator[tuple[str, str]]:
    """Yield promise and fault for each fault in how the `number`-th command of a case ended."""
    command = case.commands[number]
    for text in (out, err):
        if _UNFORESEEN.search(text):
            yield "unforeseen", text
        if visible(text) != text:
            yield "obeyed", repr(text)
    if status not in {0, 1, 2}:
        yield "status", f"{status!r} {err}"
    if status == 2 and not err.strip():
        yield "silent", out
    if any(len(line) > LONGEST_LINE for line in err.splitlines()):
        yield "endless", f"{max(map(len, err.splitlines()))} characters: {err[:200]}"
    if case.doubt and case.doubt not in out + err:
        yield "undoubted", f"not said: {case.doubt}\n{(out + err)[-500:]}"
    judges = command[0] not in {"show", "runs", "resume", "abort"} if case.record else number == 0
    if case.refuse and judges and status in {0, 1}:
        yield "accepted", f"{case.refuse}\n{(out + err)[-500:]}"
    if status in {0, 1} and command[-2:] == ["--json", "-"]:
        yield from _no_numbers(out)


def _no_numbers(out: str) -> Iterator[tuple[str, str]]:
    """Yield the faults of a result: invalid JSON, an absurdly large number, an impossible covariance."""

    def refuse(word: str) -> None:
        raise ValueError(word)

    try:
        result = json.loads(out, parse_constant=refuse)
    except ValueError as error:
        yield "result", str(error)
        return
    covariance = result.get("covariance") if isinstance(result, dict) else None
    if covariance is not None:
        c = np.array(covariance)
        r = c / np.sqrt(np.outer(np.diag(c), np.diag(c)))
        if not np.all(np.isfinite(r)) or np.linalg.eigvalsh(r).min() < -1e-6:
            yield "result", "a covariance that is none"


def called(command: list[str], stdin: bytes = b"") -> tuple[object, str, str]:
    """Carry out a command in this process; return its status, standard output and standard error."""
    from bench.cli.app import main

    out, err = (
        io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors=e, newline="")
        for e in ("strict", "backslashreplace")
    )
    given, before = io.TextIOWrapper(io.BytesIO(stdin), encoding="utf-8"), sys.stdin
    sys.stdin = given
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main(command)
        status: object = None
    except SystemExit as ended:
        status = ended.code
    finally:
        sys.stdin = before
    texts = []
    for stream in (out, err):
        stream.flush()
        texts.append(stream.buffer.getvalue().decode("utf-8", "backslashreplace"))
    return status, texts[0].replace("\r\n", "\n"), texts[1]


# --- records ------------------------------------------------------------------------------------------


def spoil_record(rng: random.Random, folder: Path) -> str:
    """Copy a run of the tests and damage it; return what must be reported, empty if it may be accepted."""
    from bench.run.events import sha256

    kept = ROOT / "tests/data/records" / rng.choice(("finished", "interrupted"))
    shutil.copytree(kept, folder)
    name = rng.choice((*["events.jsonl"] * 3, "run.json", "plan.json", "bench.yaml", "procedure.yaml"))
    file = folder / name
    data = file.read_bytes()
    if name != "events.jsonl" or rng.random() < 0.4:
        if name == "run.json" and rng.random() < 0.5:
            changed = json.dumps(spoilt_tree(rng, json.loads(data))).encode()
        else:
            changed = spoilt_bytes(rng, data)
        file.write_bytes(changed)
        if changed == data or name == "run.json":
            return ""
        ends = name == "events.jsonl" and (
            data.startswith(changed)
            or changed.startswith(data)
            or data.startswith(changed[: changed.rfind(b"\n") + 1])
        )
        return "" if ends else f"a changed {name}"
    lines = [json.loads(line) for line in data.splitlines()]
    for _ in range(rng.choice((1, 1, 3))):
        k = rng.randrange(len(lines))
        event = lines[k]
        by_tree = rng.random() < 0.5
        lines[k] = spoilt_tree(rng, event) if by_tree else {**event, rng.choice(list(event)): weird(rng)}
    if rng.random() < 0.2:
        lines[rng.randrange(len(lines))]["n"] = rng.choice((math.inf, math.nan, 1e300, -1, "1", [1]))
    previous = sha256((folder / "run.json").read_bytes())
    written = b""
    for event in lines:  # the chain of hashes is computed again, as a forger would do
        if isinstance(event, dict) and "prev" in event:
            event["prev"] = previous
        line = json.dumps(event).encode()
        previous = sha256(line)
        written += line + b"\n"
    file.write_bytes(written)
    return ""


# --- answers ------------------------------------------------------------------------------------------


def _answers(rng: random.Random) -> list[tuple[str, str]]:
    """Answer a prompt, well and badly: an answer that the program accepts must suit the prompt."""
    from bench.base.tables import Screen
    from bench.run.person import OperatorWish, ask
    from bench.run.terminal import TerminalPerson
    from drivers.interfaces import BenchError
    from drivers.person import Prompt, PromptKind

    kind = rng.choice(list(PromptKind))
    low, high = rng.choice(((None, None), (0.0, 5.0), (None, 5.0), (-10.0, None)))
    number = kind is PromptKind.NUMBER
    prompt = Prompt(
        "p", kind, rng.choice(("How much?", "\x1b[2J\u202e?")), default=rng.choice((None,
        "yes" if kind is PromptKind.CONFIRM else "1")),
        unit=rng.choice(("", "V", "°C")), choices=("a", "b") if kind is PromptKind.CHOOSE else (),
        minimum=low if number else None, maximum=high if number else None,
    )  # fmt: skip
    words = (
        *WEIRD, "yes", "no", "?", ":redo", ":skip", ":skip why", ":pause", ":abort", ":x", "a", "1 V",
        "1,5", "45 0 0", "1e400", "-inf V",
    )  # fmt: skip
    typed = "\n".join(rng.choice(words) for _ in range(rng.choice((1, 3, 40)))).encode(
        "utf-8", "surrogatepass"
    )
    typed = spoilt_bytes(rng, typed) if rng.random() < 0.3 and typed else typed
    shown = io.StringIO()
    person = TerminalPerson(
        io.TextIOWrapper(io.BytesIO(typed), encoding="utf-8"), Screen(file=shown, width=80)
    )
    broken = []
    try:
        answer = ask(person, prompt)
    except (BenchError, OperatorWish) as told:
        broken += [("unforeseen", str(told))] if _UNFORESEEN.search(str(told)) else []
    else:
        if number:
            value = float(answer.replace(",", ".").removesuffix(prompt.unit).strip())
            inside = (low is None or value >= low) and (high is None or value <= high)
            fits = math.isfinite(value) and inside and "_" not in answer
        else:
            fits = {
                "choose": answer in {"a", "b"},
                "confirm": answer.lower() in {"y", "yes", "ok", "done", "n", "no"},
            }.get(kind.value, True)
        if not fits and answer != prompt.default:
            broken.append(("accepted", f"{answer!r} at {prompt}"))
    if visible(shown.getvalue()) != shown.getvalue():
        broken.append(("obeyed", repr(shown.getvalue())))
    return broken


@contextlib.contextmanager
def own_folder(parent: Path) -> Iterator[None]:
    """Work in an empty folder, without settings in the environment, within the context."""
    folder = parent / "work"
    folder.mkdir()
    kept = {name: os.environ.pop(name, None) for name in ("BENCH_FILE", "BENCH_RUNS", "BENCH_DEVICES")}
    try:
        with contextlib.chdir(folder):
            yield
    finally:
        os.environ.update({name: value for name, value in kept.items() if value is not None})
        shutil.rmtree(folder, ignore_errors=True)
