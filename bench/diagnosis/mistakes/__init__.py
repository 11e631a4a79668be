"""Mistakes of procedure and wiring: hypotheses, compared with the readings and corrected in a copy."""
