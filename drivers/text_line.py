"""The number in a line of text that an instrument sends when requested."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from drivers.interfaces import BadReading, InstrumentRefused, message

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.wire.visa import ProvedSession

_NUMBER: Final = re.compile(r"[+-]? *\d+(?:\.\d*)?|[+-]? *\.\d+")


class TextLine:
    """A request to the instrument `name`, and the form of its reply, a line of text.

    The group `group` of `pattern` is the number in the reply. `errors` maps each line that may come instead to its
    meaning; `remedy` says what to do then.
    """

    def __init__(
        self,
        name: str,
        request: str,
        pattern: str,
        group: str,
        errors: Mapping[str, str],
        remedy: str = "clear that fault, then redo this point",
    ) -> None:
        self._name = name
        self._request = request
        self._pattern = re.compile(pattern)
        self._group = group
        self._errors = errors
        self._remedy = remedy

    def number(self, session: ProvedSession) -> float:
        """Return the number in the instrument's present reply.

        Raises `InstrumentRefused` for one of the `errors`, `BadReading` for a reply that does not match.
        """
        known = "|".join([f"(?:{self._pattern.pattern})", *map(re.escape, self._errors)])
        said = session.ask(self._request, known, message("a line that fits the pattern in the bench file"))
        if (meaning := self._errors.get(said)) is not None:
            raise InstrumentRefused(
                self._name,
                f"it says {said!r} instead of its {self._group}: {meaning}",
                self._remedy,
            )
        match = self._pattern.fullmatch(said)
        number = match[self._group] if match else ""
        if _NUMBER.fullmatch(number) is None:
            raise BadReading(
                self._name,
                f"the {self._group} in {said!r} is {number!r}, which is not a number",
                "correct the pattern in the bench file",
            )
        return float(number.replace(" ", ""))
