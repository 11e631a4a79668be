"""`bench validate`: checks that prove an installation, their register, and what a change changes in past runs."""
