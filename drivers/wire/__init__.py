"""The transport: message sessions over VISA, GPIB adapters, discovery of instruments, wire logs and replay."""
