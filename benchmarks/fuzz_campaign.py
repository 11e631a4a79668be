"""Test that the program accepts each of 20,000 invalid or unusual inputs, or refuses it in a sentence.

    python -m benchmarks.fuzz_campaign --inputs 20000 --seed 1 --jobs 2

Inputs are readings, bench files, procedures, model files, results, records, names, SCPI to the simulated meters,
answers at prompts, extreme values, pipes for files, damaged catalogues, and calls from Python. Each is made from
the seed and its number (`fuzz_inputs`, `fuzz_edges`), and tried in a separate process.

Promised: no traceback, no message of an unforeseen error, no control character for a terminal, one of the
documented statuses, no acceptance of what must be refused (signals that are not finite, an impossible covariance, a
wrong unit, a repeated key, a changed record, …), and no hang: an input that takes too long ends the campaign and is
named. A table by kind and every violation are printed; the exit status is 1 if there is one. To repeat one input:
`--only readings:17`.
"""

import contextlib
import faulthandler
import io
import json
import math
import os
import random
import re
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.text import visible
from benchmarks.campaign import ROOT, arguments, refuse, spread
from benchmarks.fuzz_edges import MADE_AT_EDGES, python_trial
from benchmarks.fuzz_inputs import MADE, WEIRD, Case, spoilt_bytes, spoilt_tree, weird

MAKERS: Final = {**MADE, **MADE_AT_EDGES}
KINDS: Final = (*MAKERS, "scpi", "answers", "python")
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
        others = {"scpi": _scpi, "answers": _answers, "python": python_trial}
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


# --- instruments --------------------------------------------------------------------------------------

_SCPI: Final = (
    "*IDN?", "*RST", "*CLS", "*TST?", "*STB?", "*ESR?", "SYST:ERR?", "READ?", "INIT", "FETC?",
    "CONF:VOLT:DC", "VOLT:DC:RANG", "VOLT:DC:NPLC",
    "SAMP:COUN", "TRIG:SOUR", "TRIG:COUN", "TRIG:DEL", "ZERO:AUTO", "FORM:READ:TIME", "ROUT:CHAN:DEL",
    "ROUT:SCAN", "MEAS:VOLT:DC?", "DATA:POIN?",
    "R?", "ABOR", "TRAC:FEED:CONT", "DISP:TEXT", "SYST:LOC", "UNIT:TEMP", "SENS:VOLT:NPLC",
    "TRAC:POIN", "TRAC:DATA?", "INP:IMP:AUTO",
)  # fmt: skip
_PARAMETERS: Final = (
    "", "10", "1,2,3", "MIN", "MAX", "DEF", "IMM", "BUS", "EXT", "ON", "OFF", "?", "(@101,102)",
    "(@101:1e9)", "(@", "1e999", "-1e999", "nan", "#H1F",
    '"a', "'b'", "1;2", "9" * 400, "0.02", "5e4", "INF", "-1", ":", "::", "?" * 50, "\x00", "\xff", "1e-999",
)  # fmt: skip
_NEVER: Final = (
    "VOLT:DC:RANG kaputt", "NONSENSE:HEADER 1", "VOLT:DC:NPLC ,", "*IDN", "SAMP:COUN -1", "*SRE 999",
    "READ? (((", "VOLT:DC:RANG 1e999",
)  # fmt: skip


def _meters() -> list[Any]:
    from bench.model import Block, ForwardModel
    from bench.model.geometry import INSTALLATION_1
    from sim.agilent_34401a import Agilent34401A
    from sim.keithley_2000 import Keithley2000
    from sim.keysight_34461a import Keysight34461A
    from sim.keysight_34970a import Keysight34970A
    from sim.world.clock import VirtualClock
    from sim.world.world import World, WorldSettings

    block = Block(np.diag([-2.177, -2.142, -2.163]), np.array([0.07, -0.2, -0.41]))
    world = World(WorldSettings(block, ForwardModel({"1": INSTALLATION_1}), {}, 3), VirtualClock())
    one = world.terminals("x")
    return [
        Agilent34401A(one, world.clock), Keysight34461A(one, world.clock), Keithley2000(one, world.clock),
        Keysight34970A({101: one, 102: one, 103: one}, world.clock),
    ]  # fmt: skip


def _scpi(rng: random.Random) -> list[tuple[str, str]]:
    """Send a few messages to a simulated meter: it must answer in ASCII, refuse errors, and keep working."""
    meter = rng.choice(_meters())
    broken, sent = [], []
    for _ in range(rng.randrange(1, 6)):
        units = [
            rng.choice(_SCPI) + rng.choice(("", " ", " ", "?")) + rng.choice(_PARAMETERS)
            for _ in range(rng.choice((1, 1, 2, 5)))
        ]
        message = ";".join(units).encode("latin-1")
        message = spoilt_bytes(rng, message) if rng.random() < 0.3 else message
        sent.append(message)
        reply = meter.handle(message, lambda: True)
        if reply is not None and not (reply.isascii() and reply.strip().decode().isprintable()):
            broken.append(("reply", f"{sent} {reply!r}"))
    meter.device_clear()
    meter.handle(b"*RST;*CLS", lambda: False)
    wrong = rng.choice(_NEVER)
    meter.handle(wrong.encode(), lambda: False)
    if (error := meter.handle(b"SYST:ERR?", lambda: False)) is None or re.match(rb"[+]?0,", error):
        broken.append(("accepted", f"{type(meter).__name__}: {wrong!r} gives {error!r}"))
    if (meter.handle(b"*CLS;*IDN?", lambda: False) or b"").count(b",") != 3:
        broken.append(("dead", f"{type(meter).__name__} after {sent}"))
    return broken


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


# --- the campaign ----------------------------------------------------------------------------------------


LIMIT_S: Final = 300.0
"""Time, s, after which an input counts as hanging; it is long, because the machine may be busy."""
TRYING: Final = "trying"
"""The file in which a process names the input that it tries."""

SHARES: Final = {
    "readings": 4, "bench": 4, "procedure": 4, "model": 2, "result": 3, "record": 2, "names": 2, "scpi": 3,
    "answers": 3, "edges": 5, "special": 2, "catalogue": 1, "python": 3,
}  # fmt: skip
"""Share of each kind among 38 inputs; kinds that take longest are rarest."""


def inputs(count: int) -> list[tuple[str, int]]:
    """Return kind and number of at least `count` inputs."""
    rounds = -(-count // sum(SHARES.values()))
    return [(kind, number) for kind in KINDS for number in range(rounds * SHARES[kind])]


@cache
def own_place(parent: str) -> Path:
    """Return a folder for this process, and load slow modules first, so that no input's time includes this."""
    import matplotlib

    os.environ["MPLCONFIGDIR"] = matplotlib.get_cachedir()  # making the list of fonts takes half a minute
    import bench.cli.app  # noqa: F401

    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(dir=parent)
    return Path(os.environ["XDG_CACHE_HOME"])


def guarded(parent: str, seed: int, which: tuple[str, int]) -> list[Violation]:
    """Try an input; one that hangs ends the campaign, and its threads are shown."""
    place = own_place(parent)
    (place / TRYING).write_text(":".join(map(str, which)))
    faulthandler.dump_traceback_later(LIMIT_S, exit=True, file=2)
    with own_folder(place):
        found = tried(which[0], seed, which[1])
    faulthandler.cancel_dump_traceback_later()
    return found


def campaign(which: Sequence[tuple[str, int]], seed: int, workers: int) -> list[Violation]:
    """Try inputs in `workers` processes; return the violations, which are also printed at once."""
    found: list[Violation] = []
    with tempfile.TemporaryDirectory() as parent:
        try:
            for new in spread(partial(guarded, parent, seed), which, workers):
                for violation in new:
                    print(told(violation), flush=True)
                found += new
        except BrokenProcessPool:
            names = [file.read_text() for file in Path(parent).glob(f"*/{TRYING}")]
            refuse(f"a process hung or died at one of these inputs: {', '.join(names)}")
    return found


def told(violation: Violation) -> str:
    """Return a violation as a line of text."""
    return f"--- {violation.kind}:{violation.number} {violation.what}\n{violation.how.rstrip()}"


def table(counts: dict[str, int], found: list[Violation]) -> str:
    """Return the table by kind of input."""
    words = sorted(
        {violation.what for violation in found} | {"traceback", "unforeseen", "obeyed", "accepted", "hang"}
    )
    lines = [f"{'input':12}{'tried':>8}" + "".join(f"{word:>12}" for word in words)]
    for kind, count in (*counts.items(), ("all", sum(counts.values()))):
        of = Counter(v.what for v in found if kind in {v.kind, "all"})
        lines.append(f"{kind:12}{count:8}" + "".join(f"{of[word]:12}" for word in words))
    return "\n".join(lines)


def main(argv: Any = None) -> int:
    given = arguments(
        __doc__, argv, inputs=20000, seed=1, workers=2,
        kinds={"nargs": "*", "choices": KINDS, "default": KINDS}, only={"metavar": "KIND:NUMBER"},
    )  # fmt: skip
    which = [(kind, number) for kind, number in inputs(given.inputs) if kind in given.kinds]
    if given.only:
        kind, _, number = given.only.partition(":")
        which = [(kind, int(number))]
    begun = time.monotonic()
    found = campaign(which, given.seed, given.workers)
    print(table(dict(Counter(kind for kind, _ in which)), found))
    print(f"{(time.monotonic() - begun) / 60:.1f} min, {given.workers} processes, seed {given.seed}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
