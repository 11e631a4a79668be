"""Analyses of many runs: drift of a block, control charts, comparison of benches, errors of a bench."""
