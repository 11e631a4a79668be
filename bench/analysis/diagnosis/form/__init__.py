"""What has no name gets a form: the few terms of a dictionary that describe it, and where the scatter is larger."""
