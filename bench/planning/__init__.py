"""Test points before they are measured: what they determine, how well, and the fewest that are enough."""
