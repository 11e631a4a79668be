"""What is true of a Turnwell 3 head. Source: its manual, page 4."""

IDENTITY = "TURNWELL"
READ_TERMINATION = "\n"
WRITE_TERMINATION = "\n"
