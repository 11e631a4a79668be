"""The operator's panel: the runs of a folder in a browser. It reads records and leaves answers and wishes."""
