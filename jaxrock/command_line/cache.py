"""The command `jaxrock cache`: what is kept between sessions."""

import argparse
import shutil

from jaxrock.command_line.command import Command
from jaxrock.keeping.folder import OF_JAX, folder, kept


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--clear", action="store_true", help="delete them")


def _run(arguments: argparse.Namespace) -> int:
    place = folder()
    if place is None:
        print("nothing is kept: JAXROCK_CACHE is off")
        return 0
    files = [file for file in kept() if file.exists()]
    size = sum(file.stat().st_size for file in files) / 2**20
    programs = sum(file.parent.name != OF_JAX or file.name.endswith("-cache") for file in files)
    if arguments.clear:
        shutil.rmtree(place, ignore_errors=True)
    print(f"{programs} compiled programs, {size:.1f} MiB, {'deleted from' if arguments.clear else 'in'} {place}")
    return 0


CACHE = Command("cache", "compiled programs that are kept between calls", _add_options, _run, computes=False)
