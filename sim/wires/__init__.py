"""Wires of simulated instruments: TCP, pseudo-terminals, a GPIB bus, and faults on them."""
