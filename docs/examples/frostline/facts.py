"""What is true of a Frostline 7 chamber. Source: its manual, page 12."""

IDENTITY = "FROSTLINE"
READ_TERMINATION = "\n"
WRITE_TERMINATION = "\n"
BUSY_S = 0.5  # pause that it needs after a command without reply
RESOLUTION_C = 0.1
