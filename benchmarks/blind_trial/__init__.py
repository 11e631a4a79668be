"""The blind trial of `bench diagnose` on simulated readings with hidden effects and mistakes.

The answers are sealed before the diagnoses are made. The simulator shares only the table of readings with the
application: its geometry, forms and shapes of effects are its own.
"""
