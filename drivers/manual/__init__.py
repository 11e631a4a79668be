"""A head and a chamber that a person works."""
