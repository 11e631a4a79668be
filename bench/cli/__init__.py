"""The `bench` command: a module for each, which reads its options, calls and prints.

A new command is a new module here and its line in `COMMANDS` of `bench.cli.commands`. Its function is decorated
with `@app.command(epilog="Example: …")`, takes the options as its parameters (`bench.cli.options` has those that
commands share), imports what computes where it uses it, so that `bench --help` stays quick, prints with
`bench.cli.printing` and returns the exit status.
"""
