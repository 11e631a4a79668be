"""Who is at the panel: tokens, one-time links, sessions, roles, and what a request must have to change anything."""
