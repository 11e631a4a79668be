"""Files that people write: bench files, model files; those that are shipped."""
