"""Chambers with a Watlow F4T controller."""
