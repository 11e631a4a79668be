"""Requests: one dataclass for each command, whose fields are its options and the parameters of the Python call."""
