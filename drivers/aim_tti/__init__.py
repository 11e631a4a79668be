"""Aim-TTi (Thurlby Thandar) power supplies."""
