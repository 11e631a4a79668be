"""The operator's panel shows runs in a browser. It reads records and stores answers and requests."""
