"""What can be asked for: a request for each command, whose fields are its options and the parameters in Python."""
