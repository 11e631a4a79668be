"""Instruments that state one serial number: one meter reached by several addresses, or one swapped for another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Final

from bench.run.answers import agree
from drivers.interfaces import Identity, Person, Prompt, PromptKind

NO_SERIAL: Final = frozenset({"", "0", "-"})
"""What an instrument says that states none: a 34401A answers 0, whichever it is."""


def same_serials(identities: Mapping[str, Identity]) -> list[str]:
    """Return a sentence for each serial number that several instruments (by name) of one model state."""
    names: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for name, identity in identities.items():
        if identity.serial.strip() not in NO_SERIAL:
            names[identity.model, identity.serial].append(name)
    return [
        f"{', '.join(alike[:-1])} and {alike[-1]} state one serial number, {serial} ({model}): "
        "if that is one instrument, the addresses in the bench file are wrong"
        for (model, serial), alike in names.items()
        if len(alike) > 1
    ]


def agree_to_others(person: Person, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Ask before going on with other instruments than those that the run was begun with; identities by name."""
    changed = [
        f"{name} was {identity} and is now {now.get(name, 'gone')}"
        for name, identity in before.items()
        if now.get(name) != identity
    ]
    if changed:
        text = f"Other instruments than before: {'; '.join(changed)}. Go on with them?"
        agree(person, Prompt(id="identities", kind=PromptKind.CONFIRM, text=text, action={"do": "ask"}))
