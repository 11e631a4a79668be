"""Uncertainty budgets: from the errors of a bench to the coefficients and to any measured acceleration."""
