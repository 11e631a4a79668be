"""Many units on many benches: crossed effects, degrees of equivalence, what a type and a history foretell."""
