"""Follows runs by their records: what is going on, as pages and their script are given it."""
