"""persons, failures, validate: the registers of a laboratory, and the proof of its installation."""

from __future__ import annotations

from bench.base.computing import one_thread
from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.requests.documents import ChangePersons, Failures, Validate


@command("bench persons add 'B. Example' --may operate --by 'A. Example'")
def persons(request: ChangePersons, json: JsonOption = None) -> int:
    """List the persons of the laboratory; add or change a person, or end their rights.

    Runs, certificates, validations, failures and the panel use these persons.
    """
    from bench.services.persons import persons as changed

    result = changed(request)
    return printing.told(result, json, result.print_on)


@command("bench failures --laboratory laboratory.yaml --year 2026 --page review.html")
def failures(request: Failures, json: JsonOption = None) -> int:
    """Collect failures of runs in a register; note remedies; write a page for the review.

    Failed and stopped runs, refused answers, repeated readings and alarms are collected from the records.
    """
    from bench.results.registers import render_failures
    from bench.validation.failures import failures as collect

    result = collect(request)
    files = () if request.page is None else [("page", request.page, render_failures(result))]
    return printing.told(result, json, result.print_on, files)


@command("bench validate --bench my-bench.yaml --out validation")
def validate(request: Validate, json: JsonOption = None) -> int:
    """Validate this installation: reference data, instruments, records, certificates, machine.

    Exit status 1 if a check fails. To accept a validation, give --accept DIR, --by NAME and --reason TEXT.
    """
    one_thread()
    from bench.validation import acceptance

    if request.accept or request.withdraw or request.register:
        if request.accept:
            entries = acceptance.accept(request, request.accept)
        elif request.withdraw:
            entries = acceptance.withdraw(request, request.withdraw)
        else:
            entries = acceptance.register_of(request)
        return printing.told(entries, json, entries.print_on)
    from bench.validation.conduct import validated

    with printing.progress(), printing.in_lines():
        result = validated(request, lambda: printing.passphrase("Passphrase of the key: "))
    printing.told(result, json, result.print_on)
    return 0 if result.passed else 1
