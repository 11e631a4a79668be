"""Many units on many benches: crossed effects of both, degrees of equivalence, what a type and a history foretell."""
