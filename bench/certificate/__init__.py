"""Certificates of calibrations: on paper and for machines, numbered, signed, registered."""
