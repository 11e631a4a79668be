"""The bench application: procedures, runs, calibration, reports."""
