"""An interlaboratory comparison: a travelling block's plan, sealed results, and their evaluation."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from bench.base.arrays import u_of
from bench.base.files import read_given, remedy_for, to_text, write_whole
from bench.base.languages import message
from bench.calibration.intrinsic import INTRINSIC
from bench.certificate.dcc.reading import coefficients_in
from bench.history.comparison import Snapshot, compare, joint_of
from bench.history.control_chart import CheckRun
from bench.history.equivalence import (
    Drift,
    against_others,
    between_laboratories,
    consensus_weights,
    covariance_of_sum,
    transport_dark,
)
from bench.history.measured import STANDARD_GRAVITY
from bench.results.interlaboratory import CHANGED_P, KitResult, drifts_of, laboratories_of, render_kit
from bench.results.parts import ValuePart
from bench.services.arguments import python_call
from bench.services.coefficients import coefficients_of, results_in, snapshot_of
from bench.services.errors import Refused
from bench.services.history import check_run
from bench.services.requests.documents import EvaluateKit, PlanKit, SealKit
from bench.services.requests.shared import runs_folder
from bench.services.source import Request, load_sources

LETTERS: Final = "ACDEFHJKLMNPQRTUVWXY34679"
CHECK: Final = "monitor-4 on arrival and before departure; both accompany the result"
"""The measurements at each stop that show a change of the block in transport."""
SHA256: Final = re.compile(r"[0-9a-f]{64}")


class _PlanPart(BaseModel):
    model_config = ConfigDict(frozen=True, coerce_numbers_to_str=True)


class Stop(_PlanPart):
    """A stop of the travelling block at a `laboratory`, for one calibration under a blind `code`.

    `pilot` says whether this is the pilot laboratory; `seal` is the result's SHA-256, empty before sealing.
    """

    code: str
    laboratory: str
    pilot: bool
    check: str = CHECK
    seal: str = ""


class Kit(_PlanPart):
    """The plan of a comparison: the travelling block and its stops at the laboratories, in order."""

    kit_file: Literal[1] = 1
    block: str
    stops: Annotated[tuple[Stop, ...], Field(min_length=1)]

    def stop(self, code: str) -> Stop:
        """Return the stop with this blind code. Raises `Refused` for an unknown code."""
        found = next((stop for stop in self.stops if stop.code == code), None)
        if found is None:
            raise Refused(
                f"{code}: the plan has no such code; choose from {', '.join(s.code for s in self.stops)}"
            )
        return found


def plan_kit(block: str, laboratories: Sequence[str], seed: int | None) -> Kit:
    """Return the plan: the first laboratory (the pilot) measures first, after every two other ones, and last.

    The order of the other laboratories and the codes are random, drawn with `seed`; without one nobody can draw
    them again. Raises `Refused` for fewer than three laboratories, or a name given twice.
    """
    if len(laboratories) < 3 or len(set(laboratories)) < len(laboratories):
        raise Refused(
            "--laboratory: a comparison needs three or more laboratories, each named once; add "
            "--laboratory NAME for each, the pilot first"
        )
    rng = np.random.default_rng(seed)
    pilot, *others = laboratories
    route = [pilot]
    for k, at in enumerate(rng.permutation(len(others)), 1):
        route += [others[at], *([pilot] if k % 2 == 0 or k == len(others) else [])]
    codes: list[str] = []
    while len(codes) < len(route):
        code = "".join(rng.choice(list(LETTERS), 4))
        codes += [code] * (code not in codes)
    pairs = zip(codes, route, strict=True)
    stops = tuple(Stop(code=code, laboratory=name, pilot=name == pilot) for code, name in pairs)
    return Kit(block=block, stops=stops)


def write_kit(path: Path, kit: Kit) -> None:
    """Write the plan as YAML; only the coordinator may have it, because it maps codes to laboratories."""
    write_whole(path, yaml.safe_dump(kit.model_dump(mode="json"), sort_keys=False, allow_unicode=True))


def load_kit(path: Path) -> Kit:
    """Read a plan that `write_kit` wrote. Raises `Refused` for another file."""
    try:
        return Kit.model_validate(yaml.safe_load(read_given(path)))
    except OSError as error:
        remedy = remedy_for(error, "check the name")
        raise Refused(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except (yaml.YAMLError, ValueError):
        raise Refused(f"{path}: not a plan of 'bench kit plan'; give the file that it wrote") from None


def seal_of(result: str) -> str:
    """Return the seal of a result: the SHA-256 of the file `result`, or `result` itself if it is a seal."""
    if SHA256.fullmatch(result):
        return result
    try:
        return hashlib.sha256(read_given(Path(result))).hexdigest()
    except OSError as error:
        raise Refused(f"{result}: cannot be read ({error.strerror}); give a file or its SHA-256") from error


def kit_evaluated(request: EvaluateKit) -> KitResult:
    """Compare each laboratory with the consensus of the others, as `bench kit evaluate` does.

    Sensitivities, offsets and angles between the axes are compared, since the mounting does not change them.
    Results and checks are given as CODE=FILE. A result is a file of `calibrate --json`, or a DCC (XML, PDF) of any
    program; `g` is the local gravity (m/s²) for a DCC that does not state it. A `check` is a run of a monitor
    procedure at a stop, in order of time. If checks or the pilot's results show a significant change of the
    block, the u of each difference is widened. Raises `Refused` for a missing result or seal, or a broken one.
    """
    kit, given, g_m_s2 = load_kit(Path(request.plan)), _results(request), request.g
    checks = _by_code(request.check)
    problems = [f"{s.code}: no result is given; add {s.code}=FILE" for s in kit.stops if s.code not in given]
    problems += [
        f"{s.code}: has no seal; seal every result before any is opened" for s in kit.stops if not s.seal
    ]
    for code, result in given.items():
        if kit.stop(code).seal and seal_of(result) != kit.stop(code).seal:
            problems.append(
                f"{code}: {result} is not the file that was sealed; ask the laboratory for that file"
            )
    if problems:
        raise Refused("\n".join(problems))
    read = {s.code: _read(Path(given[s.code]), g_m_s2) for s in kit.stops}
    for (code, (one, _)), (other, (same, _)) in combinations(read.items(), 2):
        if np.array_equal(one.vector, same.vector):
            raise Refused(
                f"{code}, {other}: the results are the same to the last digit; ask for a result of each calibration"
            )
    there = {code: replace(one, block=kit.block) for code, (one, _) in read.items()}
    pilots = [s.code for s in kit.stops if s.pilot]
    once = [s.code for s in kit.stops if s.code not in pilots[1:]]
    units = {one.unit: code for code, one in there.items()}
    if len(units) > 1:
        each = ", ".join(f"{code} in {unit}" for unit, code in sorted(units.items()))
        raise Refused(
            f"the results are in different units ({each}); compare calibrations whose signals have one unit"
        )
    nine = [there[code].per_standard_g().in_nine() for code in once]
    values = np.array([one.vector for one in nine])
    drifts = [*_between_pilots(pilots, there), *_between_checks(kit, checks)]
    transport = transport_dark([drift for *_, drift in drifts], INTRINSIC)
    n, m = values.shape
    # K2 and K3 of the one block are errors of every laboratory: no mean reduces them
    errors = joint_of(nine).whole(np.zeros((n, m, m))).reshape(n, m, n, m)
    judged = against_others(values, errors, transport)
    errors = between_laboratories(errors, transport)
    weights, dark = consensus_weights(values, errors)
    u = np.sqrt(u_of(covariance_of_sum(weights, errors)) ** 2 + dark**2 * np.sum(weights**2, axis=0))
    p_same = compare([there[code] for code in pilots]).nine.p_constant if len(pilots) > 1 else None
    off = [code for code, one in zip(once, judged, strict=True) if one.off]
    parts = drifts_of(drifts)
    return KitResult(
        block=kit.block, unit=next(iter(units)), g_m_s2=STANDARD_GRAVITY,
        consensus={
            name: ValuePart(value=float(v), u=float(s))
            for name, v, s in zip(INTRINSIC, np.sum(weights * values, axis=0), u, strict=True)
        },
        dark=dict(zip(INTRINSIC, dark.tolist(), strict=True)), laboratories=laboratories_of(once, judged),
        transport_p=p_same, drifts=parts, transport=dict(zip(INTRINSIC, transport.tolist(), strict=True)), off=off,
        accepted=not off and (p_same is None or p_same >= CHANGED_P) and not any(one.changed for one in parts),
        notes=[
            *_other_blocks({code: one.block for code, (one, _) in read.items()}),
            *(f"{code}: {note}" for code, (_, notes) in read.items() for note in notes),
        ],
    )  # fmt: skip


def _other_blocks(named: Mapping[str, str]) -> Iterator[str]:
    """Yield a note if results name several blocks; `named` has the block by code, "" if not stated."""
    codes: dict[str, list[str]] = {}
    for code, block in named.items():
        codes.setdefault(block, []).append(code)
    codes.pop("", None)
    if len(codes) > 1:
        each = "; ".join(f"{block}: {', '.join(of)}" for block, of in codes.items())
        yield message(f"the results name several blocks ({each}); check that each is of the travelling block")


_Seen = tuple[str, str, Literal["calibration", "monitor"], Drift]


def _between_pilots(pilots: Sequence[str], there: Mapping[str, Snapshot]) -> Iterator[_Seen]:
    """Yield the change of the nine numbers from one stop of the pilot to the next; common errors cancel."""
    for first, last in pairwise(pilots):
        nine = [
            there[code].per(there[first].g_m_s2, there[first].gravity_u).in_nine() for code in (first, last)
        ]
        covariance = joint_of(nine).of_sums(np.tile([-1.0, 1.0], (len(INTRINSIC), 1)))
        yield first, last, "calibration", Drift(INTRINSIC, nine[1].vector - nine[0].vector, covariance)


def _between_checks(kit: Kit, checks: Mapping[str, Sequence[str]]) -> Iterator[_Seen]:
    """Yield the change of the block between successive monitor runs at a stop, and between the pilot's stops."""
    before: tuple[str, CheckRun] | None = None
    for stop in sorted(kit.stops, key=lambda stop: not stop.pilot):
        of_stop = Request(list(checks.get(stop.code, ())), runs_folder(None))
        runs = [check_run(source) for source in load_sources(of_stop)]
        before = before if stop.pilot else None
        for run in runs:
            if before is not None:
                code, own = before
                if own.names != run.names:
                    raise Refused(
                        f"{code}, {stop.code}: the monitor runs turned different axes; give runs of one monitor "
                        "procedure"
                    )
                dof, covariance = own.s_dof + run.s_dof, own.covariance + run.covariance
                yield code, stop.code, "monitor", Drift(run.names, run.value - own.value, covariance, dof)
            before = stop.code, run


def _read(path: Path, g_m_s2: float | None) -> tuple[Snapshot, list[str]]:
    """Return a result, and notes on it; none on its signature, which names the laboratory."""
    notes: list[str] = []
    if path.suffix.lower() in {".xml", ".pdf"}:
        data, (_, *notes) = coefficients_in(path, g_m_s2, "0 V")
    else:
        (data, _), *more = results_in(path)
        if more:
            raise Refused(f"{path}: has {len(more) + 1} results; give a file with one")
    one = snapshot_of(data, str(path))
    if not coefficients_of(data, str(path)).fits:
        notes.append(message("not accepted by its laboratory: the readings contradict the model"))
    if one.simulated:
        notes.append(message("of simulated instruments"))
    if one.block_terms is None:
        notes.append(
            message(
                "states no part of u from K2 and K3 of the block, which all laboratories share; u of the "
                "consensus may be too small"
            )
        )
    return one, notes


def _by_code(given: Sequence[str]) -> dict[str, list[str]]:
    """Return the files by code. Raises `Refused` for a text that is not CODE=FILE."""
    files: dict[str, list[str]] = {}
    for code, _, file in (one.partition("=") for one in given):
        if not code or not file:
            lacking = "the file" if code else "the code"
            raise Refused(f"'{code or file}': {lacking} is missing; give each file as CODE=FILE")
        files.setdefault(code, []).append(file)
    return files


def _results(request: SealKit) -> dict[str, str]:
    files = _by_code(request.results)
    if twice := [code for code, given in files.items() if len(given) > 1]:
        raise Refused(
            f"{', '.join(twice)}: several results were given for one code; give each code once, as CODE=FILE"
        )
    return {code: file for code, (file,) in files.items()}


def kit_planned(request: PlanKit) -> Kit:
    """Plan the route of the block with a blind code for each stop, and write the plan (`bench kit plan`).

    Raises `Refused` for a plan that exists, fewer than three laboratories, or a name given twice.
    """
    path = Path(request.plan)
    if path.exists():
        raise Refused(f"{path}: exists, and a plan is not overwritten; name another")
    kit = plan_kit(request.block, request.laboratory, request.seed)
    write_kit(path, kit)
    return kit


def kit_sealed(request: SealKit) -> Kit:
    """Write the seal (SHA-256) of each result, given as CODE=FILE, into the plan; return the plan.

    Raises `Refused` for an unknown code, or for one that is sealed with another result.
    """
    path = Path(request.plan)
    kit, given = load_kit(path), _results(request)
    for code in given:
        if kit.stop(code).seal not in {"", seal_of(given[code])}:
            raise Refused(
                f"{code}: is sealed already with another result; give that one, or plan a new comparison"
            )
    stops = (
        stop.model_copy(update={"seal": seal_of(given[stop.code])}) if stop.code in given else stop
        for stop in kit.stops
    )
    kit = kit.model_copy(update={"stops": tuple(stops)})
    write_kit(path, kit)
    return kit


kit_plan = python_call(PlanKit, kit_planned, "kit_plan")
kit_seal = python_call(SealKit, kit_sealed, "kit_seal")
kit_evaluate = python_call(EvaluateKit, kit_evaluated, "kit_evaluate")


def files_of(result: KitResult, out: Path) -> Iterator[tuple[str, Path, str]]:
    """Yield description, path in the folder `out` and text of two files: the result and the report."""
    yield "result", out / "kit.json", to_text(result.to_dict())
    yield "report", out / "kit.html", render_kit(result)
