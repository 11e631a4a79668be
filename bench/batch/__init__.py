"""The same work over many runs, restartable, by processes or a cluster; a table of what changed."""
