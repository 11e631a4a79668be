"""Uncertainty budgets: from the errors of a bench to the coefficients and to any measured acceleration."""

from bench.budget.coefficients import Budget, Contribution, make_budget
from bench.budget.estimators import ESTIMATORS, gain
from bench.budget.propagation import COVERAGE, Inputs, Propagated, propagate
from bench.budget.setup import Setup, make_setup, planned_conditions, rows_of
from bench.budget.sources import Source, bench_sources, influences, stand_source, stand_sources

__all__ = [
    "COVERAGE",
    "ESTIMATORS",
    "Budget",
    "Contribution",
    "Inputs",
    "Propagated",
    "Setup",
    "Source",
    "bench_sources",
    "gain",
    "influences",
    "make_budget",
    "make_setup",
    "planned_conditions",
    "propagate",
    "rows_of",
    "stand_source",
    "stand_sources",
]
