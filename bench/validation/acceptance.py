"""Acceptance of a validation by an authorised person, and withdrawal: both are entries of the register."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from bench.base.files import read_regular
from bench.certificate.laboratory import Person, load_laboratory
from bench.results.registers import RegisteredValidation, ValidationRegisterResult, ValidationResult
from bench.run.events import sha256
from bench.run.seal import read_seal
from bench.services.chain import Entry, civil_now, opened
from bench.services.errors import Refused, refusing
from bench.services.requests.documents import Validate
from bench.services.validated import (
    ACCEPTED,
    WITHDRAWN,
    Validations,
    digest_of,
    fingerprint,
    laboratory_needed,
)
from bench.validation.conduct import RESULT, damage_of
from bench.validation.machine import compared
from drivers.clock import utc_now


def accept(request: Validate, folder: Path) -> ValidationRegisterResult:
    """Register the validation in a folder as accepted by an authorised person; return the register.

    The first validation is accepted in the same way. Raises `Refused` if the validation has a failed check, differs
    from its seal, is registered already, or is of another program, package, Python or platform. Also raises it if
    laboratory file, person or reason is missing, or if the person is not authorised.
    """
    laboratory, person, reason = _authority(request)
    content, result = _sealed(folder)
    if result.failed:
        names = ", ".join(one.name for one in result.failed[:3])
        raise Refused(
            f"{folder}: {len(result.failed)} checks failed ({names}); mend what they name and validate again"
        )
    here = fingerprint()
    if here.fingerprint != result.program.fingerprint:
        changed = compared(here.files, result.program.files)
        what = "packages, Python or platform" if changed.passed else changed.found
        raise Refused(f"{folder}: the program was changed since ({what}); validate again, then accept")
    with opened(Validations.beside(laboratory)) as register:
        digest = sha256(content)
        if any(one.data.get("result_sha256") == digest for one in register.standing()):
            raise Refused(f"{folder}: this validation is registered already; nothing was changed")
        count = sum(one.kind == ACCEPTED for one in register.entries)
        data = {
            "role": person.role,
            "reason": reason,
            "fingerprint": result.program.fingerprint,
            "bench": Path(result.bench.file).name,
            "bench_sha256": result.bench.sha256,
            "plug_ins": digest_of(result.bench.plug_ins),
            "result_sha256": register.keep(content),
            "changes": [one.name for one in result.changes],
            "quick": result.quick,
        }
        now = utc_now()
        register.append(Entry(ACCEPTED, f"V{now:%Y}-{count + 1:04d}", civil_now(), person.name, data))
        return listed(register)


def withdraw(request: Validate, number: str) -> ValidationRegisterResult:
    """Register the withdrawal of the validation `number`; return the register.

    Raises `Refused` for an unknown number, without laboratory file or reason, and if the person is not authorised.
    """
    laboratory, person, reason = _authority(request)
    with opened(Validations.beside(laboratory)) as register:
        found = next((one for one in register.standing() if one.number == number), None)
        if found is None:
            known = ", ".join(one.number for one in register.standing()[-3:]) or "none"
            raise Refused(
                f"{number}: no valid validation in {register.folder} has this number; the latest are: {known}"
            )
        told = {**found.data, "role": person.role, "reason": reason}
        register.append(Entry(WITHDRAWN, number, civil_now(), person.name, told))
        return listed(register)


def register_of(request: Validate) -> ValidationRegisterResult:
    """Return a laboratory's register without changing it. Raises `Refused` if no laboratory file is given."""
    return listed(Validations.beside(_laboratory(request)).read_lines())


def listed(register: Validations) -> ValidationRegisterResult:
    """Return the content of a register as a result."""
    holding: dict[tuple[str, str], str] = {}
    for one in register.standing():
        holding[one.data["fingerprint"], one.data["bench_sha256"]] = one.number
    latest = set(holding.values())
    rows = [
        RegisteredValidation.from_object(
            one,
            holds=one.kind == ACCEPTED and one.number in latest,
            quick=bool(one.data.get("quick", False)),
            **{
                name: one.data[name]
                for name in ("role", "reason", "fingerprint", "bench", "bench_sha256", "result_sha256")
            },
        )
        for one in register.entries
    ]
    return ValidationRegisterResult(register_=str(register.folder), head=register.head, validations=rows)


def _laboratory(request: Validate) -> Path:
    return laboratory_needed(request.laboratory, "it names who may accept, and its folder holds the register")


def _authority(request: Validate) -> tuple[Path, Person, str]:
    """Return laboratory file, authorised person and reason. Raises `Refused` if one is missing."""
    laboratory = _laboratory(request)
    needed = {"--by NAME": request.by, "--reason TEXT": request.reason}
    lacking = [option for option, given in needed.items() if not given]
    if lacking or request.by is None or request.reason is None:
        raise Refused(f"an entry of the register needs {' and '.join(lacking)}; add what is missing")
    return laboratory, load_laboratory(laboratory).authorised_person(request.by, "--by"), request.reason


def _sealed(folder: Path) -> tuple[bytes, ValidationResult]:
    """Return the result in a folder, as bytes and parsed. Raises `Refused` if it differs from its seal."""
    try:
        with refusing("name the folder of a validation", folder / RESULT, reading=True):
            content, seal = read_regular(folder / RESULT), read_seal(folder)
        result = ValidationResult.model_validate_json(content)
    except ValidationError as error:
        raise Refused(f"{folder / RESULT}: not the result of a validation; validate again") from error
    if seal is None or (wrong := damage_of(folder, seal)):
        raise Refused(f"{folder}: {'; '.join(wrong) if seal else 'it has no seal'}; validate again")
    return content, result
