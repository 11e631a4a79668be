"""Espec chambers with a P300 or SCP-220 controller."""
