"""Rate tables with an ACUTROL controller."""
