"""The operator's panel: a web server that shows runs. It reads records and stores answers and requests."""
