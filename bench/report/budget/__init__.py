"""The page of a budget and its figures."""
