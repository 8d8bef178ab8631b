"""The interface of a command of `jaxrock`: its name, purpose, options and action."""

import argparse
from collections.abc import Callable
from typing import NamedTuple

from jaxrock.command_line.output import Report


class Command(NamedTuple):
    """One command.

    - `name`: its word on the command line; `purpose`: one line of help.
    - `add_options`: adds the command's own options to a parser; all commands that compute have `--model` and `--out`.
    - `run`: runs the command, and reports results, written files and failures. **Raises:** ValueError or OSError for
      bad input, before it writes anything.
    - `computes`: whether it computes scenes.
    - `writes`: returns the names of files that the command may write into its folder, for given options.
    """

    name: str
    purpose: str
    add_options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Report], None]
    computes: bool = True
    writes: Callable[[argparse.Namespace], tuple[str, ...]] = lambda _: ()
