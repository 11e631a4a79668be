"""The unsigned PDF of a certificate: the same content gives the same bytes, whoever makes it and whenever."""

from __future__ import annotations

import json
import re
from datetime import datetime
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

from bench.api.errors import Refused
from bench.certificate.content import Certificate
from bench.certificate.paper.page import attachments_of, data_of

if TYPE_CHECKING:
    pass

_TEMPLATE: Final = "certificate.typ"
_NO_SIGN: Final = re.compile(r'the text `"(.+?)"` could not be displayed')


def body_of(certificate: Certificate, dcc: bytes) -> bytes:
    """Return the PDF/A-3b of a certificate with its files attached, `dcc` its digital certificate (XML).

    Raises `Refused` for a logo that is no picture, and for a letter that the fonts have no sign for.
    """
    given = {one.name: one.content.decode() for one in attachments_of(certificate, dcc)}
    data = {"data": json.dumps(data_of(certificate, dcc)), **given}
    return typeset_pdf(data, _moment(certificate))


def pictures_of(certificate: Certificate, dcc: bytes, dots_per_inch: float = 110.0) -> list[bytes]:
    """Return the pages as pictures (PNG). Raises as `body_of`."""
    given = {one.name: one.content.decode() for one in attachments_of(certificate, dcc)}
    data = {"data": json.dumps(data_of(certificate, dcc)), **given}
    import typst

    made = typst.compile(
        _template(), format="png", ppi=dots_per_inch, ignore_system_fonts=True, sys_inputs=data
    )
    return made if isinstance(made, list) else [made]


def typeset_pdf(data: dict[str, str], moment: int) -> bytes:
    """Set the template with its inputs; `moment` (s since 1970) is when the file says that it was made."""
    import typst

    try:
        made: Any = typst.compile(
            _template(),
            format="pdf",
            pdf_standards=["a-3b"],
            ignore_system_fonts=True,
            timestamp=moment,
            sys_inputs=data,
        )
    except typst.TypstError as error:
        found = _NO_SIGN.search(str(error))
        if found is None:
            raise
        raise Refused(
            f"the fonts of a certificate have no sign for {found[1]}; write the name that has it in Latin, Greek "
            "or Cyrillic letters"
        ) from error
    return bytes(made)


def _template() -> bytes:
    return files(__package__).joinpath(_TEMPLATE).read_bytes()


def _moment(certificate: Certificate) -> int:
    """Return when it was issued, of a draft when the run ended, s since 1970; 0 where nobody knows."""
    told = certificate.found.ended if certificate.issue is None else certificate.issue.issued
    try:
        return int(datetime.fromisoformat(told).timestamp())
    except ValueError:
        return 0
