"""Commissioning: a first evening with the instruments of a bench, each looked at from all sides once."""
