"""Analyses of many runs: drift of a block, control charts, comparison of benches, sizes of a bench."""
