"""validate: an installation proved by checks, its acceptance and register."""

from __future__ import annotations

from bench.base.computing import one_thread
from bench.cli import printing
from bench.cli.options import JsonOption, app, requested
from bench.services.requests.documents import Validate


@app.command(epilog="Example: bench validate --bench my-bench.yaml --out validation")
@requested
def validate(request: Validate, json: JsonOption = None) -> int:
    """Validate this installation: reference data, instruments, records, certificates, machine.

    Exit status 1 if a check fails. To accept it, give --accept DIR, --by NAME and --reason TEXT.
    """
    one_thread()
    from bench.validation import acceptance

    out = printing.console(json=json)
    if request.accept or request.withdraw or request.register:
        if request.accept:
            entries = acceptance.accept(request, request.accept)
        elif request.withdraw:
            entries = acceptance.withdraw(request, request.withdraw)
        else:
            entries = acceptance.register_of(request)
        entries.print_on(out)
        printing.write_json([entries.to_dict()], json)
        return 0
    from bench.validation.conduct import validated

    with printing.progress(), printing.in_lines():
        result = validated(request, lambda: printing.passphrase("Passphrase of the key: "))
    result.print_on(out)
    for file in result.files:
        out.print(f"  {file}")
    printing.write_json([result.to_dict()], json)
    return 0 if result.passed else 1
