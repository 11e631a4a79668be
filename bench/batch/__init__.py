"""The same work on many runs, by processes or a cluster, restartable; a table of what changed."""
