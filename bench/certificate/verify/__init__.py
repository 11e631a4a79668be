"""Whether a certificate is intact, who signed it, and what that does not prove."""
