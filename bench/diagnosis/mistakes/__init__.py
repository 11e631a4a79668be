"""Mistakes of procedure and wiring: supposed in turn, held against the readings, put right in a copy."""
