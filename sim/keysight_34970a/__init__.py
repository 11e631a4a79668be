"""A simulated 34970A or 34972A with 34901A cards."""
