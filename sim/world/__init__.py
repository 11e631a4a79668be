"""The physical truth of a simulated bench: head, block, temperature, time, operator."""
