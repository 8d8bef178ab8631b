"""The command `jaxrock`: one module for each of its commands.

Imports everything. Start with `main`, then `run`; another command is a module like `run`, and its entry in `main`.
"""
