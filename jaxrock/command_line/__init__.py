"""The command `jaxrock`: one module for each of its commands.

The package imports all others. Start reading with `main`, then `run`. To add a command, write a module like `run`, and
add an entry in `main`.
"""
