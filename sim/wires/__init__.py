"""How messages reach simulated instruments: TCP, pseudo-terminals, a GPIB bus, and what goes wrong there."""
