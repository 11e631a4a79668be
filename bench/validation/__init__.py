"""`bench validate`: checks that prove an installation, their register, and how past runs change with a program."""
