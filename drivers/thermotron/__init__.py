"""Thermotron chambers."""
