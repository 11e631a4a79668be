"""persons: who works in the laboratory and may do what, in a chained register."""

from __future__ import annotations

from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.requests.documents import ChangePersons


@command("bench persons add 'B. Example' --may operate --by 'A. Example'")
def persons(request: ChangePersons, json: JsonOption = None) -> int:
    """List the persons of the laboratory; add one, change one, or end one's rights.

    Runs, certificates, validations, failures and the panel use these persons.
    """
    from bench.services.persons import persons as changed

    result = changed(request)
    return printing.told(result, json, result.print_on)
