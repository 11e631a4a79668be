"""Runs: carry out, record, watch and resume a plan on a bench; assemble and commission the instruments."""
