"""Rotary stages with a Newport ESP301 motion controller."""
