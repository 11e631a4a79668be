"""A simulated HP, Agilent, Keysight 34401A."""
