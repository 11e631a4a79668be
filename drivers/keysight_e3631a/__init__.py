"""HP / Agilent / Keysight E3631A."""
