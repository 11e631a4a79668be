"""Uncertainty budgets: from the errors of a bench to the coefficients and to any measured acceleration."""

from bench.analysis.budget.coefficients import Budget, Contribution, make_budget
from bench.analysis.budget.estimators import gain
from bench.analysis.budget.propagation import COVERAGE, Inputs, Propagated, propagate
from bench.analysis.budget.setup import Setup, make_setup, planned_conditions
from bench.analysis.budget.sources import ErrorSource, bench_sources, influences, stand_source, stand_sources

__all__ = [
    "COVERAGE",
    "Budget",
    "Contribution",
    "ErrorSource",
    "Inputs",
    "Propagated",
    "Setup",
    "bench_sources",
    "gain",
    "influences",
    "make_budget",
    "make_setup",
    "planned_conditions",
    "propagate",
    "stand_source",
    "stand_sources",
]
