"""Whether a signer is one whom a file of certificates stands for."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING

from bench.certificate.signature.signatory import fingerprint_of

if TYPE_CHECKING:
    from cryptography.x509 import Certificate


def why_not_trusted(chain: Sequence[Certificate], when: datetime, trusted: Sequence[Certificate]) -> str:
    """Return why a signer's certificate is not one of `trusted`, nor issued under one of them; "" where it is.

    `chain` begins with the signer's, the others may link it to one of `trusted`. It is asked of the moment `when`.
    No list of withdrawn certificates is asked.
    """
    own = chain[0]
    if fingerprint_of(own) in {fingerprint_of(one) for one in trusted}:
        if own.not_valid_before_utc <= when <= own.not_valid_after_utc:
            return ""
        return "its certificate was not in force at the time that the signature says"
    from asn1crypto.x509 import Certificate as Asn1
    from cryptography.hazmat.primitives.serialization import Encoding
    from pyhanko_certvalidator import CertificateValidator, ValidationContext
    from pyhanko_certvalidator.errors import PathBuildingError, PathValidationError, ValidationError

    first, *others = (Asn1.load(one.public_bytes(Encoding.DER)) for one in chain)
    roots = [Asn1.load(one.public_bytes(Encoding.DER)) for one in trusted]
    context = ValidationContext(trust_roots=roots, moment=when, allow_fetching=False)
    validator = CertificateValidator(first, intermediate_certs=others, validation_context=context)
    try:
        asyncio.run(validator.async_validate_path())
    except PathBuildingError:
        return "no certificate in the trust file stands for it"
    except (PathValidationError, ValidationError) as error:
        return " ".join(str(error).split())
    return ""
