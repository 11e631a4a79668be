"""Leica Nivel210 and Nivel220 two-axis inclination sensors."""
