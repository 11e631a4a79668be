"""Facts of each instrument with their source: dialect, limits, accuracy.

Driver, simulation and bench file share it.
"""
