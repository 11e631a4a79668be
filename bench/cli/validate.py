"""validate: an installation proved by checks, its acceptance and register."""

from __future__ import annotations

from bench.base.computing import one_thread
from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.requests.documents import Validate


@command("bench validate --bench my-bench.yaml --out validation")
def validate(request: Validate, json: JsonOption = None) -> int:
    """Validate this installation: reference data, instruments, records, certificates, machine.

    Exit status 1 if a check fails. To accept it, give --accept DIR, --by NAME and --reason TEXT.
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
