"""Facts about each instrument with their sources: command dialect, limits, accuracy.

Drivers, simulations and the checks of bench files share them.
"""
