"""The wires: message sessions over VISA, GPIB adapters, what is found on them, their log."""
