"""What each command does, apart from how it is typed: each function returns the exit status."""


class CommandError(Exception):
    """A command that cannot be carried out as asked; the text says why and what to do."""
