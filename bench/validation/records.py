"""Records of runs: a dry run from procedure to coefficients; killed and resumed; changed; a certificate of it."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from openpyxl import load_workbook
from rich.console import Console
from scipy import stats

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.yaml_files import load_document
from bench.calibration.conformity import DecisionRule, MeasuredValues, probability_outside
from bench.config.procedure.load import check as plan_check
from bench.config.procedure.load import load_procedure
from bench.config.shipped import CERTIFICATE, find_bench, find_procedure, shipped_folder
from bench.exchange.forms import FORMS
from bench.exchange.result import BlockResult
from bench.model.geometry import COEFFICIENTS, Block
from bench.run.events import EVENTS
from bench.run.folder import Run
from bench.services.calibration import calibration_of
from bench.services.chain import LINES
from bench.services.errors import Refused
from bench.services.execution import carry_out, new_run
from bench.services.requests.documents import RevokeCertificate
from bench.services.requests.measuring import RunRequest
from bench.services.source import Request, load_sources
from bench.services.validated import ROOT
from bench.validation.paper_bench import U0, K
from bench.validation.reference import agreement
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter
from drivers.clock import SystemClock, utc_now

check = partial(enter, family=message("records", "heading"))

PROCEDURE: Final = "quick"
SEED: Final = 34
FALSE_ALARM: Final = 1e-4
KILLS, QUICK_KILLS = (12, 30, 55), (30,)
"""Numbers of events after which a run is killed."""
_WAIT_S: Final = 900.0
"""Longest time (s) to wait for the program; only one that hangs takes so long."""
_COMMAND: Final = "from bench.cli.program import main; main()"


def bench_to_run(context: Context) -> tuple[Path, str]:
    """Return the bench file on which the validation makes its runs, and a note.

    The shipped bench paper-stand is used if the given bench cannot run the procedure; the note then says so.
    """
    plan = load_procedure(find_procedure(PROCEDURE)).expand()
    if not plan_check(plan, context.bench, dry_run=True):
        return context.bench_path, ""
    return find_bench("paper-stand"), "; on paper-stand, as this bench cannot run the procedure 'quick'"


def whole_run(context: Context) -> Run:
    """Return a finished dry run of 'quick' on the bench under validation, made at the first call."""
    return _finished(context, bench_to_run(context)[0], "whole")


def standard_run(context: Context) -> Run:
    """Return a finished dry run of the shipped bench paper-stand; its record suffices for a certificate."""
    return _finished(context, find_bench("paper-stand"), "standard")


def _finished(context: Context, bench: Path, name: str) -> Run:
    if name not in context.shared:
        runs = context.scratch / "runs"
        new = new_run(
            RunRequest(
                PROCEDURE, str(bench), seed=SEED, name=name, runs=runs, dry_run=True, operator="bench validate"
            )
        )  # fmt: skip
        carry_out(Run(new.folder), new.record(), Console(file=io.StringIO(), quiet=True))
        context.shared[name] = Run(new.folder)
    run: Run = context.shared[name]
    return Run(run.folder)


@check("run on the simulated bench", "7.2.1", "", place="bench/run, drivers, sim", p_false=FALSE_ALARM,
       source="truth of the simulated bench; chi-square distribution")  # fmt: skip
def from_run_to_coefficients(context: Context) -> Finding:
    """Run the procedure 'quick' dry, and compare its coefficients with the true ones of the simulated bench."""
    run, (_, note) = whole_run(context), bench_to_run(context)
    (source,) = load_sources(Request([str(run.folder)], run.folder.parent))
    found = calibration_of(source)
    truth, simulation = source.bench.simulation.block, source.bench.simulation
    if truth is None or simulation.effects:
        words = f"{len(source.readings)} readings, calibrated; the simulation has effects{note}"
        return Finding(True, words, expected="calibrated")
    true = np.concatenate([np.ravel(truth.K), truth.U0])
    off = found.calibration.block.vector - true
    u = found.calibration.u
    known = u > 0
    chi2 = float(
        off[known] @ np.linalg.pinv(found.covariance[np.ix_(known, known)], hermitian=True) @ off[known]
    )
    limit = float(stats.chi2.isf(FALSE_ALARM, int(known.sum())))
    words = f"χ² = {chi2:.1f} of {int(known.sum())} coefficients{note}"
    return Finding(chi2 <= limit, words, expected=f"χ² ≤ {limit:.1f}")


@check(
    "killed and resumed",
    "7.11.3",
    "the same readings as without the kill",
    place="bench/run/record.py, bench/run/resume.py",
)
def killed(context: Context) -> Iterator[Finding]:
    """Kill the program during a run, resume it, and compare its readings with those of an uninterrupted run."""
    whole = whole_run(context).readings()
    bench, note = bench_to_run(context)
    runs = context.scratch / "runs"
    for events in QUICK_KILLS if context.quick else KILLS:
        name = f"killed-{events}"
        began = _program(
            "run", PROCEDURE, "--dry-run", "--bench", bench, "--seed", SEED, "--runs", runs, "--name", name
        )
        reached = _killed_after(began, runs / name / EVENTS, events)
        resumed = _program("resume", name, "--runs", runs)
        said = resumed.communicate(timeout=_WAIT_S)[1].decode(errors="replace")
        run = Run(runs / name)
        if run.history.problems or resumed.returncode not in {0, 1}:
            why = "; ".join(run.history.problems) or said.strip().splitlines()[-1]
            yield Finding(False, why, of=f"after {reached} events")
            continue
        same = np.array_equal(run.readings().signal, whole.signal)
        words = f"{len(run.readings())} readings, {'the same' if same else 'others'}{note}"
        yield Finding(bool(same), words, of=f"after {events} events or more")


def _program(*arguments: object) -> subprocess.Popen[bytes]:
    """Start the program in a separate process, with the code of this program and one thread."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    around = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(  # noqa: S603 - this program, arguments of our own
        [sys.executable, "-c", _COMMAND, *map(str, arguments)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=around,
    )  # fmt: skip


def _killed_after(process: subprocess.Popen[bytes], events: Path, count: int) -> int:
    """Kill a program when its record has `count` lines; return the number of lines after its end."""
    clock = SystemClock()
    deadline_s, lines = clock.now_s() + _WAIT_S, 0
    while process.poll() is None and clock.now_s() < deadline_s:
        lines = events.read_bytes().count(b"\n") if events.is_file() else 0
        if lines >= count:
            break
        clock.sleep(0.002)
    process.kill()
    process.communicate()
    return lines


@check("changed record", "7.5.2", "refused", place="bench/run/record.py")
def changed(context: Context) -> Iterator[Finding]:
    """Change one digit of a recorded reading, remove a line, change an input: each must be detected and named."""
    run = whole_run(context)
    lines, at, digit = _with_another_digit(run)
    for of, content in {
        "a digit": [*lines[:at], digit, *lines[at + 1 :]],
        "a line taken out": [*lines[:at], *lines[at + 1 :]],
    }.items():
        yield _refusal(run, of, {EVENTS: b"".join(content)})
    yield _refusal(run, "the bench file", {"bench.yaml": b"# " + (run.folder / "bench.yaml").read_bytes()})


def _with_another_digit(run: Run) -> tuple[list[bytes], int, bytes]:
    """Return the lines of a record, the index of a reading, and that line with the last digit of a mean changed."""
    lines = (run.folder / EVENTS).read_bytes().splitlines(keepends=True)
    at = next(n for n, line in enumerate(lines) if b'"mean": [' in line)
    last = re.compile(rb'("mean": \[-?\d*\.?\d*)(\d)')
    return (
        lines,
        at,
        last.sub(lambda number: number[1] + b"%d" % ((int(number[2]) + 1) % 10), lines[at], count=1),
    )


def changed_copy(run: Run) -> Run:
    """Copy a run within its folder of runs, change one digit of a reading, and return the copy."""
    lines, at, digit = _with_another_digit(run)
    return _copy(run, f"{run.name}-changed", {EVENTS: b"".join([*lines[:at], digit, *lines[at + 1 :]])})


def _copy(run: Run, name: str, contents: dict[str, bytes]) -> Run:
    copy = run.folder.with_name(name)
    shutil.copytree(run.folder, copy)
    for file, content in contents.items():
        (copy / file).write_bytes(content)
    return Run(copy)


def _refusal(run: Run, of: str, contents: dict[str, bytes]) -> Finding:
    problems: Any = _copy(run, f"changed-{of.replace(' ', '-')}", contents).history.problems
    return Finding(bool(problems), "; ".join(problems) or "taken as whole", of=of)


# --- certificates -------------------------------------------------------------------------------------

UNITS = {"units": [{"received": "2026-11-16", "condition": "undamaged", "state": "as found"}]}
"""An order of any unit."""


def write_files(folder: Path, laboratory: Any = None, order: Any = None) -> tuple[Path, Path]:
    """Write the shipped laboratory and order files into a folder; return both paths.

    The mappings `laboratory` and `order` replace sections of the files; None as a section removes it.
    """
    written = []
    for name, sections in (("laboratory", laboratory), ("order", order)):
        data = yaml.safe_load((shipped_folder(CERTIFICATE) / f"{name}.yaml").read_text(encoding="utf-8"))
        data = {**data, **(sections or {})}
        for key in [key for key, value in data.items() if value is None]:
            del data[key]
        written.append(folder / f"{name}.yaml")
        written[-1].write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    return written[0], written[1]


@check("certificate", "7.8.1", "", family=message("certificates", "heading"), place="bench/certificate")
def life(context: Context) -> Iterator[Finding]:
    """Issue the certificate of a dry run, verify, change and revoke it; try to issue one for a changed record."""
    try:
        from bench.certificate import life as certificates
        from bench.certificate.verify import verify_certificate
    except ImportError as missing:
        yield Finding(
            True, f"this installation issues none ({missing.name} is not installed)", expected="none"
        )
        return
    run, folder = standard_run(context), context.scratch / "laboratory"
    folder.mkdir()
    laboratory, order = write_files(folder, order=UNITS)
    desk = certificates.Desk(
        run.folder.parent, load_document(laboratory), load_document(order), "A. Example", utc_now
    )
    issued = next(iter(certificates.issue_all([run.name], desk)))
    yield Finding(
        issued.why is None, issued.why or f"issued as {issued.number}", of="issued", expected="a number"
    )
    if issued.why is not None:
        return

    def judged(suffix: str, of: str, expected: str = "refused") -> Finding:
        file = folder / "register" / f"{issued.number}{suffix}"
        try:
            found = verify_certificate(file, None, run.folder.parent, folder / "register")
        except Refused as refusal:
            return Finding(expected != "accepted", str(refusal), of=of, expected=expected)
        as_expected = expected == ("accepted" if found.accepted else "refused")
        return Finding(as_expected, found.verdict, of=of, expected=expected)

    for suffix in (".xml", ".pdf"):
        yield judged(suffix, f"unchanged {suffix}", "accepted")
        file = folder / "register" / f"{issued.number}{suffix}"
        content = file.read_bytes()
        at = len(content) // 2
        file.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        yield judged(suffix, f"one bit changed in {suffix}")
        file.write_bytes(content)
    number = str(issued.number)
    certificates.revoke(
        RevokeCertificate(number, reason="trial", laboratory=laboratory, authorised_by="A. Example")
    )
    yield judged(".pdf", "revoked")
    lines = folder / "register" / LINES
    content = lines.read_bytes()
    lines.write_bytes(content.replace(b"A. Example", b"B. Example", 1))
    # the certificate is revoked by now: only a refusal of the register itself shows that the line was noticed
    yield judged(".pdf", "a changed line of the register", "the register refused")
    lines.write_bytes(content)
    changed = next(iter(certificates.issue_all([changed_copy(run).name], desk)))
    yield Finding(
        changed.why is not None, changed.why or "issued", of="of a changed record", expected="refused"
    )


# --- what leaves the program: statements of conformity, numbers and units of exported files --------------


given_out = partial(enter, family=message("results given out"))

DIODE_FAR_V: Final = 100.0
"""A limit on the other side, which the example does not have and this one does not reach."""
_SAID: Final = "pass, conditional pass, conditional fail, fail"


@given_out("conformity", "7.8.6", "", place="bench/calibration/conformity.py",
       source="JCGM 106:2012, 7.3, 7.4, 8.3.2; distributions of scipy.stats")  # fmt: skip
def conformity(context: Context) -> Iterator[Finding]:
    """Compute the conformance probabilities of two published examples, and the acceptance limits of the rules."""
    diode = 1.0 - probability_outside(DIODE_FAR_V - 0.07, 0.05, DIODE_FAR_V)
    yield agreement("diode, 1.4 u within one limit, printed 0.92", diode, 0.92, 0.005)
    oil = 1.0 - probability_outside(13.6 - 14.4, 1.8, 1.9)
    yield agreement("oil, viscosity within two limits, printed 0.66", oil, 0.66, 0.005)
    for dof in (np.inf, 5.0):
        of_u = stats.norm() if np.isinf(dof) else stats.t(dof)
        factor = of_u.ppf(stats.norm.cdf(2.0))
        known = MeasuredValues(np.ones(4), np.full(4, factor), np.full(4, dof))
        limit = 20.0
        for rule, expected in (
            (DecisionRule.of(None), limit - of_u.ppf(0.95)),
            (DecisionRule.of("guarded"), limit - factor),
            (DecisionRule.of("simple"), limit),
        ):
            words = "5 % risk" if rule.guard_band is None else rule.name
            found = rule.acceptance_limit(limit, known)
            yield agreement(f"acceptance limit, {words}, {dof:g} degrees of freedom", found, expected, 2e-3)
        guard = of_u.ppf(0.95)
        beside = np.array([at + side for at in (limit - guard, limit + guard) for side in (-0.01, 0.01)])
        said = ", ".join(DecisionRule.of(None).statements(beside, limit, known))
        yield Finding(said == _SAID, said, of=f"statements, {dof:g} degrees of freedom", expected=_SAID)


OF_K, OF_U0, OF_N = "V/g", "V", "g/V"
U: Final = 1e-6 * np.arange(1.0, 13.0)
"""The u of the twelve coefficients, all different, so that an exchange of two is noticed."""


def expected() -> dict[str, tuple[float, float | None, str]]:
    """Return value, U (None: not compared) and unit of each exported number of the paper's block, by name."""
    unit = [OF_K] * 9 + [OF_U0] * 3
    own = zip(COEFFICIENTS, [*K.ravel(), *U0], 2.0 * U, unit, strict=True)
    inverse = zip(COEFFICIENTS[:9], np.linalg.inv(K).ravel(), strict=True)
    return {
        **{name: (float(value), float(expanded), of) for name, value, expanded, of in own},
        **{f"N{name[1:]}": (float(value), None, OF_N) for name, value in inverse},
    }


def as_expected(of: str, rows: Iterable[tuple[Any, ...]]) -> Finding:
    """Return the finding on rows of name, value, U and unit of an exported file."""
    found = {str(name): (float(value), float(u), str(unit)) for name, value, u, unit in rows}
    wrong = []
    for name, (value, expanded, unit) in expected().items():
        mine = found.get(name, (np.nan, np.nan, "missing"))
        same = np.isclose(mine[0], value, rtol=1e-12, atol=0.0) and mine[2] == unit
        if not same or (expanded is not None and not np.isclose(mine[1], expanded, rtol=1e-12, atol=0.0)):
            wrong.append(f"{name} {mine[0]:.9g} {mine[2]}, U {mine[1]:.3g}")
    return Finding(not wrong, "; ".join(wrong[:3]) or f"{len(expected())} numbers", of=of)


@given_out("exports", "7.11.6", "values, U and units as given", place="bench/exchange",
       source="(11), its matrix inverted by numpy; readers of CSV, JSON and workbooks")  # fmt: skip
def exports(context: Context) -> Iterator[Finding]:
    """Export the paper's coefficients in each form, and read names, values, U and units back by separate code."""
    result = BlockResult(Block(K, U0), np.diag(U**2), "V", 9.80665, "validation")
    text = {name: FORMS[name].write(result, None) for name in ("csv", "json", "c", "excel")}
    rows = [row for row in csv.reader(io.StringIO(str(text["csv"]))) if len(row) == 5 and row[0][0] in "KNU"]
    yield as_expected("CSV", ((name, value, expanded, unit) for name, value, _, expanded, unit in rows))
    told = json.loads(text["json"])
    both = {**told["inverse"]["values"], **told["coefficients"]}
    yield as_expected("JSON", ((name, one["value"], one["U"], one["unit"]) for name, one in both.items()))
    book = load_workbook(io.BytesIO(bytes(text["excel"])))  # type: ignore[arg-type]
    cells = [
        row for sheet in ("inverse", "coefficients") for row in book[sheet].iter_rows(2, values_only=True)
    ]
    yield as_expected("workbook", ((row[0], row[1], row[3], row[4]) for row in cells if row[0]))
    for name, wanted in (("n", np.linalg.inv(K).ravel()), ("u0", U0)):
        body = re.search(rf"static const double coefficients_{name}\[[^=]*= (\{{[^;]*\}});", str(text["c"]))
        found = re.findall(r"-?\d[\d.e+-]*", body[1]) if body else [np.nan] * len(wanted)
        yield agreement(f"C header, {name}", np.array(found, float), wanted, 1e-12)
    yield from parameters()


PARAMETERS: Final = {
    "px4": ("CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE", r"{}\s+(\S+)"),
    "ardupilot": ("INS_ACCOFFS_{}", "INS_ACCSCAL_{}", r"{}[,\s]+(\S+)"),
}
"""For each autopilot, the names of an axis's offset and scale, and the pattern of a line of its file."""


def parameters() -> Iterator[Finding]:
    """Yield the findings on autopilots: with their parameters, an axis that points up must read 1 g in m/s²."""
    g, nominal = 9.80665, np.array([-2.0, -2.1, -2.2])
    own = np.diag(K)
    result = BlockResult(Block(np.diag(own), U0), np.diag(U**2), "V", g, "validation")
    for name, (offset, scale, line) in PARAMETERS.items():
        text = str(FORMS[name].write(result, nominal))

        def read(parameter: str, text: str = text, line: str = line) -> float:
            found = re.search(rf"(?m)^[^#\n]*{line.format(parameter)}", text)
            return float(found[1]) if found else np.nan

        bias, gain = (
            np.array([read(one.format(axis.upper())) for axis in CHANNELS]) for one in (offset, scale)
        )
        up, down = (((sign * own + U0) * g / nominal - bias) * gain for sign in (1.0, -1.0))
        # the parameters are single precision
        yield agreement(FORMS[name].words, [*up, *down], [g] * 3 + [-g] * 3, 1e-5)
