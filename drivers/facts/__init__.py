"""What is true of each instrument, with its source: dialect, limits, accuracy.

Driver, simulation and bench file share it.
"""
