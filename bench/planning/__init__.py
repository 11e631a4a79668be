"""Planning of test points: what readings at them will determine, how well, and the fewest that suffice."""
