"""Commissioning: a first session with the instruments of a bench, in which every function is checked once."""
