"""Mistakes of procedure and wiring: each is supposed, compared with the readings, and corrected in a copy."""
