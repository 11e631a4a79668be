"""The page of a diagnosis, its figures and its words."""
