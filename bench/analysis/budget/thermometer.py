"""How far the temperature told may be from the block's: certificate or kind of the thermometer, and a gradient."""

from __future__ import annotations

import math
from typing import Final

from bench.analysis.budget.meters import Size
from bench.files.bench.file import BenchFile
from bench.model import Distribution

GRADIENT: Final = Distribution(0.2, "rectangular")
"""Prior of what lies between a thermometer at the block and its accelerometers, K."""


def thermometer_size(bench: BenchFile) -> Size | None:
    """Return it in K; None for a chamber's thermometer that has no certificate: the band of the air is larger."""
    told_by = bench.instruments.thermometer or bench.instruments.chamber
    certificate = None if told_by is None else told_by.certificate
    size: Size | None = None
    if certificate is not None:
        worst = max(certificate.values, key=lambda value: value.U / value.k)
        origin = f"certificate {certificate.number} of {certificate.date}: the largest U, k = {worst.k:g}"
        size = Size(Distribution(worst.U, k=worst.k), origin, worst.dof)
    thermometer = bench.instruments.thermometer
    if thermometer is None:
        return size
    if size is None:
        limit = Distribution(thermometer.tolerance_k, "rectangular")
        size = Size(limit, f"no certificate: ±{limit.limit:.2g} K of its kind", prior=True)
    stated = thermometer.gradient
    gradient = GRADIENT if stated is None else Distribution(stated, "rectangular")
    origin = f"{size.origin}; ±{gradient.limit:g} K to the block" + (" as usual" if stated is None else "")
    both = Distribution(math.hypot(size.distribution.u, gradient.u))
    return Size(both, origin, size.dof, size.prior or stated is None)
