"""Mistakes of procedure and wiring, found by comparing hypotheses, and corrected in a copy of the record."""
