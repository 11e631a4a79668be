"""Runs: a plan carried out on a bench, recorded, watched, resumed; instruments assembled and commissioned."""
