"""Statistics apart from any bench: variance components, run lengths, multiple testing."""
