"""Bench files: the instruments, the stand's errors, the block, what is accepted, what is simulated."""
