"""Rotary stages with a Zaber controller."""
