"""One module for each make or model: its driver."""
