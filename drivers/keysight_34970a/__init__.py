"""The HP, Agilent, Keysight 34970A and 34972A with 34901A cards."""
