"""The command `jaxrock cache`: compiled programs that are kept between sessions."""

import argparse

from jaxrock.command_line.command import Command
from jaxrock.command_line.output import Report
from jaxrock.compiler import cache


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--clear", action="store_true", help="delete them")


def _run(arguments: argparse.Namespace, report: Report) -> None:
    place = cache.folder()
    if place is None:
        report.results |= {"folder": None, "programs": 0, "mebibytes": 0.0}
        return report.say("nothing is kept: JAXROCK_CACHE is off")
    files = [file for file in cache.files() if file.exists()]
    size = sum(file.stat().st_size for file in files) / 2**20
    programs = sum(map(cache.is_program, files))
    if arguments.clear:
        cache.clear()
        if left := [file for file in cache.files() if file.exists()]:
            raise OSError(f"{len(left)} of {len(files)} files in {place} cannot be deleted, such as {left[0]}")
    report.results |= {"folder": str(place), "programs": programs, "mebibytes": size, "deleted": arguments.clear}
    report.say(f"{programs} compiled programs, {size:.1f} MiB, {'deleted from' if arguments.clear else 'in'} {place}")


CACHE = Command("cache", "compiled programs that are kept between calls", _add_options, _run, computes=False)
