"""Records of runs: their list, content and seals, and the evidence that they are unchanged."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bench.base.files import read_regular
from bench.base.languages import message
from bench.readings.columns import columns_of, ranges_in_words
from bench.results.records import ProvenRecordPart, RunPart, RunsResult, ShowResult
from bench.run import seal as seals
from bench.run.events import ENDED, RecordError, RunState
from bench.run.folder import VERIFY, Digest, Digests, Run, all_runs, find_run, statement_in
from bench.run.record import is_being_written
from bench.services.errors import Refused, refusing
from bench.services.requests.measuring import SealRun, ShowRun
from bench.services.requests.shared import name_to_type, resume_to_type, runs_folder
from drivers.clock import utc_now

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey


def run_summaries(runs: Path) -> RunsResult:
    """Return the list of the runs in a folder, oldest first. Nothing in that folder is opened for writing."""
    digests = Digests(runs)
    found = [run_summary(run, digests.of) for run in all_runs(runs)]
    digests.save()
    return RunsResult(runs=found)


def run_summary(run: Run, digest_of: Callable[[Run], Digest] = Digest.of) -> RunPart:
    """Return a run's row in the list of runs; for a run that cannot be read, the row states the reason."""
    try:
        digest = digest_of(run)
        state, to_go_on = _state_and_next(run, digest)
        return RunPart(
            name=run.name,
            created=run.created,
            instruments="simulated" if run.simulated else ("-" if state == "imported" else "real"),
            state=state,
            readings=int(run.manifest["readings"]) if run.imported else digest.readings,
            verdict=None if digest.problems else _verdict(run),
            to_go_on=to_go_on,
        )
    except (RecordError, ValueError, TypeError, KeyError) as reason:
        damage = f"damaged: {reason}"
        return RunPart(
            name=run.name, created="", instruments="-", state=damage, readings=0, verdict=None, to_go_on=""
        )


def show_run(run: Run, request: ShowRun) -> ShowResult:
    """Return the content of a run and, if requested, the evidence for its record.

    Raises the errors of `proof_of`.
    """
    told: list[str] = []
    problems = list(run.history.problems)
    if request.proved and not problems:
        told, problems = proof_of(run, request)
    summary = run_summary(run).to_dict()
    record = ProvenRecordPart(**run.record_head, told=told)
    return ShowResult(**summary, manifest=dict(run.manifest), record=record, problems=problems)


def supply_in_words(run: Run) -> str:
    """Return the ranges of voltage and current that each supply rail had; "" if they were not measured."""
    if run.imported:
        return ""
    return ranges_in_words(columns_of([one.rails for one in run.history.readings.values()]))


def _verdict(run: Run) -> str | None:
    try:
        found = json.loads(read_regular(run.folder / f"{VERIFY}.json").decode())
        statement = statement_in(found)
        return {"pass": "passed", "fail": "failed"}.get(statement, statement)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _state_and_next(run: Run, digest: Digest) -> tuple[str, str]:
    """Return the state of a run in words, and the command that continues it (empty if nothing is to be done)."""
    if digest.problems:
        return message("damaged"), f"bench show {name_to_type(run.folder)} --verify"
    if run.imported:
        return "imported", ""
    state = digest.state
    wanted = run.results_missing if state is RunState.FINISHED else state not in ENDED
    if not wanted or is_being_written(run.folder):
        return state.value, ""
    unfinished = message("unfinished")
    alive = {
        RunState.READY: message("not begun"), RunState.RUNNING: unfinished, RunState.PAUSED: unfinished,
    }  # fmt: skip
    return alive.get(state, state.value), f"bench resume {resume_to_type(run.folder)}"


NOTHING_OUTSIDE = message(
    "this check does not show removed last lines or a recomputed chain; --head HEAD does, with a head that "
    "was noted elsewhere"
)


@dataclass(frozen=True)
class SealResult:
    """A seal, its file and, if a requested time stamp is missing, the reason."""

    seal: seals.Seal
    file: Path
    no_time_stamp: str = ""


def seal_run(request: SealRun, passphrase: Callable[[], bytes]) -> SealResult:
    """Seal an ended run, even if the server gives no time stamp. Raises `RecordError`, `Refused`."""
    run, key, server = find_run(request.run, runs_folder(request.runs)), request.key, request.timestamp
    if server is not None:
        seals.check_server(server)
    seal = seals.new_seal(run, utc_now())
    if key is not None:
        seal = seals.signed(seal, *seals.sign(seals.private_key(key, passphrase), seal.signed_bytes))
    missing = ""
    if server is not None:
        try:
            seal = replace(seal, time_stamp=seals.ask_time_stamp(server, seal.stamped_bytes))
        except seals.NoTimeStamp as reason:
            missing = str(reason)
    with refusing("nothing was sealed"):
        return SealResult(seal, seals.write_seal(run.folder, seal), missing)


def proof_of(run: Run, request: ShowRun) -> tuple[list[str], list[str]]:
    """Return the evidence that a record is unchanged, and the problems with it, a sentence each.

    Evidence is the seal and, if the user states them, the hash of the last line (head) as noted elsewhere, a
    public key and a time-stamp authority. Raises `Refused` for an invalid head, `RecordError` for a bad key.
    """
    head, key, authority = request.head, request.key, request.authority
    if head is not None and re.fullmatch(r"[0-9a-f]{64}", head.lower()) is None:
        raise Refused(f"--head {head}: give the SHA-256 of a line, 64 hexadecimal digits")
    given = None if key is None else seals.read_public_key(key)
    told, problems = [f"head: {run.history.head}"], []
    outside = False
    if head is not None:
        if head.lower() == run.history.head:
            outside = True
            told.append(message("the head equals the given one: no line was changed, removed or added since"))
        else:
            problems.append(
                message(
                    "--head: the hash of the record's last line differs from the given one; check the name of the "
                    "run, then restore the run from a copy"
                )
            )
    try:
        seal = seals.read_seal(run.folder)
        if seal is None:
            told.append(message("the run has no seal"))
            if key is not None or authority is not None:
                problems.append(
                    message(
                        "the run has no seal for --key or --authority to check; make one with 'bench seal RUN'"
                    )
                )
        else:
            outside |= _signature(seal, given, told, problems)
            outside |= _time_stamp(seal, authority, told, problems)
            problems += seal.differences(run)
    except RecordError as error:
        problems.append(str(error))
    if not outside and not problems:
        told.append(NOTHING_OUTSIDE)
    return told, problems


def _signature(
    seal: seals.Seal, given: Ed25519PublicKey | None, told: list[str], problems: list[str]
) -> bool:
    """Add sentences on the seal's signature to `told` or `problems`; return whether key `given` made it."""
    if not seal.signature:
        told.append(
            message(
                f"sealed at {seal.events} events, not signed: anybody who can write the folder could have "
                "made this seal"
            )
        )
        if given is not None:
            problems.append(message("the seal has no signature for --key to check; remove --key"))
        return False
    key = seals.public_key(seal.public_key, "the seal")
    if not seals.is_signed(key, seal.signature, seal.signed_bytes):
        problems.append(message("the signature does not belong to this seal; restore the seal from a copy"))
        return False
    name = seals.fingerprint(key)
    if given is None:
        told.append(
            message(
                f"sealed at {seal.events} events, signed with the key {name}; --key FILE checks whose key it is"
            )
        )
        return False
    if seals.fingerprint(given) != name:
        problems.append(
            message(f"the seal is signed with another key than the given one; give the key {name}")
        )
        return False
    told.append(
        message(
            f"sealed at {seal.events} events, signed with the given key, by the owner of its private half"
        )
    )
    return True


def _time_stamp(seal: seals.Seal, authority: Path | None, told: list[str], problems: list[str]) -> bool:
    """Add sentences on the time stamp to `told` or `problems`; return whether a trusted authority made it."""
    if not seal.time_stamp:
        told.append(
            message(f"no time stamp: only the computer's clock states that it was sealed at {seal.sealed}")
        )
        if authority is not None:
            problems.append(
                message("the seal has no time stamp for --authority to check; remove --authority")
            )
        return False
    try:
        stamp = seals.read_time_stamp(seal.time_stamp, seal.stamped_bytes, authority)
    except seals.NoTimeStamp as error:
        problems.append(str(error))
        return False
    at = stamp.time.isoformat()
    if stamp.trusted:
        told.append(message(f"time-stamped by the given authority: the record existed by {at}"))
    else:
        told.append(message(f"its time stamp states {at}; --authority FILE checks who issued it"))
    return stamp.trusted
