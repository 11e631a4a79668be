"""The `bench` command line: its modules read the options of commands, call the services and print results.

To add a command, add a module here and a line to `COMMANDS` of `bench.cli.commands`. The command's function is
decorated with `@command("bench … ")`, an example of its use. The options of the command are the fields of its
request and the other parameters of the function. `bench.cli.options` has the options that several commands share.
The function imports the code that computes only where it calls this code, so that `bench --help` is quick. It
prints with `bench.cli.printing` and returns the exit status.
"""
