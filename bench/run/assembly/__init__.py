"""Assembly of a bench from its parts: drivers, and simulated instruments for dry runs."""
