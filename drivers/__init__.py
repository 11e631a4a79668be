"""Instrument drivers behind abstract interfaces; nothing here knows the bench application."""
