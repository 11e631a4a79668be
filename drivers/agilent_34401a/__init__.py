"""The HP, Agilent, Keysight 34401A."""
