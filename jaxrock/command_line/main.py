"""The command line: responses, spectra, overturning maps, critical scales, fragilities, motions that rocks allow."""

import argparse
import contextlib
import io
import os
import sys
from importlib.metadata import version
from pathlib import Path

import jax

from jaxrock.command_line.cache import CACHE
from jaxrock.command_line.command import Command
from jaxrock.command_line.critical import CRITICAL
from jaxrock.command_line.fragility import FRAGILITY
from jaxrock.command_line.invert import INVERT
from jaxrock.command_line.map import MAP
from jaxrock.command_line.options import as_typed, inputs_of
from jaxrock.command_line.output import Report, complain, drop, heard
from jaxrock.command_line.parser import Parser
from jaxrock.command_line.results import HASH_FILE, ResultFolder
from jaxrock.command_line.run import RUN
from jaxrock.command_line.spectrum import SPECTRUM
from jaxrock.compiler import cache
from jaxrock.sweeps.devices import use_cpu_devices

# To add a command, write a module like `run` and add it here.
_COMMANDS = {command.name: command for command in (RUN, SPECTRUM, MAP, CRITICAL, FRAGILITY, INVERT, CACHE)}

_EXAMPLES = """\
  jaxrock run                                     a 0.6 m x 3 m block under the built-in 1979 record
  jaxrock run motion.AT2 --width 0.5 --height 2   the same for your block and record
  jaxrock run data.csv --dt 0.01 --unit cm/s2     a column of numbers
  jaxrock run --animate                           and a film of it, animation.gif
  jaxrock spectrum motion.AT2 --slenderness 5     blocks of height/width 5, every size
  jaxrock spectrum motions/*.AT2                  a suite: every record, the median and 16 to 84 %
  jaxrock map --pulse cosine --points 200         who overturns under a pulse
  jaxrock critical motion.AT2 --narrowest 1e-3    scales of a record at which a block topples and stands again
  jaxrock fragility motions/*.AT2 --width 0.5     how probable it is that a block topples
  jaxrock invert --example > rocks.csv            a table of rocks, to be filled with yours
  jaxrock invert rocks.csv --scatter 0.2          what motion rocks that stand or fell allow
  jaxrock cache --clear                           forget what was compiled before
"""
_RESULTS = f"""\
The next run replaces results in --out that jaxrock wrote and that are unchanged; {HASH_FILE} lists them.
It replaces other files, and inputs, with --force only."""
_EXIT = "exit status: 0 good, 1 something was not computed, 2 bad input, 130 interrupted, 141 nobody reads it any more"


def _epilog(command: str = "") -> str:
    """Return examples of a command, or of all, and the meaning of exit statuses."""
    lines = [line for line in _EXAMPLES.splitlines() if line.startswith(f"  jaxrock {command}")]
    return "\n".join(["examples:", *lines, "", *([] if command == "cache" else [_RESULTS, ""]), _EXIT])


def _parser() -> argparse.ArgumentParser:
    shared = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    description = "Rocking and overturning of free-standing blocks under earthquakes."
    parser = Parser(prog="jaxrock", description=description, epilog=_epilog(), **shared)
    parser.add_argument("--version", action="version", version=f"jaxrock {version('jaxrock')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in _COMMANDS.values():
        told = {"help": command.purpose, "description": command.purpose, "epilog": _epilog(command.name)}
        sub = commands.add_parser(command.name, **told, **shared)
        sub.add_argument("--json", action="store_true", help="print one JSON object, for programs")
        sub.add_argument(
            "-q", "--quiet", action="store_true", help="print nothing but what went wrong, and the object of --json"
        )
        sub.add_argument("-v", "--verbose", action="store_true", help="also say what the package does")
        if command.computes:
            models, folder = ("housner", "linear"), Path("results")
            sub.add_argument("--model", choices=models, default="housner", help="equation of motion (default housner)")
            sub.add_argument("--out", type=Path, default=folder, help=f"folder for what is written (default {folder})")
            words = "also replace inputs, and files in --out that jaxrock did not make, or that were changed later"
            sub.add_argument("--force", action="store_true", help=words)
        command.add_options(sub)
    return parser


def main(words: list[str] | None = None) -> int:
    """Run the command line.

    **Arguments:**

    - `words`: of the command; None: those of the process.

    **Returns:** the exit status: 0 good, 1 not computed, 2 bad input, 130 interrupted, 141 if the reader of a pipe has
    closed it.
    """
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # else a character outside its encoding would raise
    try:
        return _done(words)
    except KeyboardInterrupt:
        complain("interrupted")
        return 130
    except BrokenPipeError:
        drop(sys.stdout)
        return 141
    except OSError as error:  # help or an example cannot be printed
        complain(f"error: {error}")
        drop(sys.stdout)
        return 2


def _open_closed_streams() -> None:
    """Open streams that the caller has closed (`>&-`) onto the null device.

    Otherwise the next opened files get their descriptors, and C libraries print into those files.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


def _done(words: list[str] | None) -> int:
    try:
        arguments = _parser().parse_args(words)
    finally:
        sys.stdout.flush()  # argparse exits after printing help; a failed flush must raise here, not at exit
    command = _COMMANDS[arguments.command]
    report = Report(command.name, arguments.json, arguments.quiet)
    with heard(arguments.quiet, arguments.verbose):
        try:
            if command.computes:
                _prepare(command, arguments)
            command.run(arguments, report)
            status = report.finished()
            sys.stdout.flush()
            return status
        except BrokenPipeError:
            raise
        except (ValueError, OSError) as error:
            complain(f"error: {as_typed(str(error), arguments)}")
            drop(sys.stdout)
            return 2


def _prepare(command: Command, arguments: argparse.Namespace) -> None:
    """Prepare a command that computes: check and open its folder of results, and configure JAX."""
    if arguments.out.exists() and not arguments.out.is_dir():  # raise before the computation, not after it
        raise NotADirectoryError(f"Argument `--out` must be a folder, but {arguments.out} is a file.")
    there = next(place for place in (arguments.out, *arguments.out.absolute().parents) if place.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise PermissionError(f"Argument `--out` must be a folder that can be written, but {arguments.out} is not.")
    arguments.out = ResultFolder(arguments.out, inputs_of(arguments), arguments.force)
    arguments.out.check(command.writes(arguments))
    cache.keep_compiled()
    jax.config.update("jax_enable_x64", True)
    import matplotlib

    matplotlib.use("Agg")
    with contextlib.suppress(RuntimeError):  # a calling program has already initialised JAX
        use_cpu_devices()
