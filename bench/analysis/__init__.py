"""What readings tell: coefficients, budgets, plans, temperature, stability, history, mistakes, the diagnosis."""
