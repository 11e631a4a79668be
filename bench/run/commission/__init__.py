"""Commissioning: a first session in which each function of each instrument of a bench is checked once."""
