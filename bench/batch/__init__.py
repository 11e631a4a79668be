"""Batches: one command for many runs, restartable, on processes or a cluster; a table of what changed."""
