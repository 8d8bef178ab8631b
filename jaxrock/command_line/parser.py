"""A parser for words and options of the command, whose errors suggest the nearest known word."""

import argparse
import re
from typing import NoReturn

from jaxrock._core.did_you_mean import did_you_mean


class Parser(argparse.ArgumentParser):
    """Argparse's parser, whose errors suggest the nearest known word."""

    def error(self, message: str) -> NoReturn:
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        option = re.search(r"unrecognized arguments: (--[^\s=]+)", message)
        hint = ""
        if choice:
            hint = did_you_mean(choice[1], re.findall(r"[\w-]+", choice[2]))
        elif option:
            hint = did_you_mean(option[1], [word for word in self._option_string_actions if word.startswith("--")])
        super().error(f"{message}.{hint}" if hint else message)

    def parse_args(self, args=None, namespace=None):  # type: ignore[override]  # of overloads
        """Parse as argparse does, but report unknown arguments with the usage of the command itself."""
        found, unknown = self.parse_known_args(args, namespace)
        if unknown:
            self._of(found.command).error(f"unrecognized arguments: {' '.join(unknown)}")
        return found

    def _of(self, command: str) -> argparse.ArgumentParser:
        (commands,) = (each for each in self._actions if isinstance(each, argparse._SubParsersAction))
        return commands.choices[command]
