"""`bench validate`: checks of an installation, a register of validations, and past runs recomputed."""
