"""The machine-readable certificate: DCC 3.3.0 with quantities of D-SI 2.2.1, written, checked and read back."""
