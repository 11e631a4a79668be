"""Noise and drift of a signal at rest: Allan deviation, noise terms, and how long a reading should average."""

from bench.analysis.stability.advice import Averaging, ReadingAdvice, averaging, reading_advice
from bench.analysis.stability.allan import AllanCurve, allan_curve
from bench.analysis.stability.noise_terms import TERMS, NoiseTerms, fit_terms
from bench.analysis.stability.static_record import StaticRecord, from_columns, read_static

__all__ = [
    "TERMS",
    "AllanCurve",
    "Averaging",
    "NoiseTerms",
    "ReadingAdvice",
    "StaticRecord",
    "allan_curve",
    "averaging",
    "fit_terms",
    "from_columns",
    "read_static",
    "reading_advice",
]
