"""Measuring until it is good enough: what of a plan is done next, and when nothing more is needed."""
