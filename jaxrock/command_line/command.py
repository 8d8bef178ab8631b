"""What a command of `jaxrock` must tell: its name, what it is for, its options, and what it does."""

import argparse
from collections.abc import Callable
from typing import NamedTuple

from jaxrock.command_line.output import Report


class Command(NamedTuple):
    """One command.

    - `name`: its word; `purpose`: one line of help.
    - `add_options`: adds to a parser what only this command has; all that compute have `--model` and `--out`.
    - `run`: does it, and tells a report what it found, what it wrote, and what was not computed. **Raises:**
      ValueError or OSError for input that is bad, before anything is written.
    - `computes`: whether it computes scenes.
    - `writes`: names of the files that it may write into its folder, for these options.
    """

    name: str
    purpose: str
    add_options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Report], None]
    computes: bool = True
    writes: Callable[[argparse.Namespace], tuple[str, ...]] = lambda _: ()
