"""Procedures: from a file of steps to a plan that is checked, listed and carried out."""
