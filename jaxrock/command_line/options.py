"""Options that several commands share, and the objects that they describe."""

import argparse
import glob
import os
import re
from collections.abc import Callable
from functools import partial
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

import jaxrock as rk
from jaxrock.motions.files.reading import FORMATS
from jaxrock.motions.pulses import PULSES
from jaxrock.motions.pulses.pulse import AbstractPulse


def plain_float(text: str) -> float:
    """Parse the number of an option; unlike `float`, refuse underscores between digits."""
    if "_" in text:
        raise ValueError
    return float(text)


plain_float.__name__ = "number"  # in messages of argparse

_KINDS = "PEER AT2, CSMIP V1 or V2, COSMOS, ESM, SMC, K-NET, CSV or text file"
_ENDINGS = tuple(
    sorted({*(x for each in FORMATS.values() for x in each.suffixes), ".acc", ".asc", ".csv", ".dat", ".txt"})
)


def model_of(arguments: argparse.Namespace) -> rk.models.AbstractEquation:
    """Return the equation of motion."""
    return rk.Linear() if arguments.model == "linear" else rk.Housner()


def add_restitution(parser: argparse.ArgumentParser) -> None:
    """Add the options of the block's impacts: its restitution, and the side to which a wall opens."""
    parser.add_argument(
        "--restitution", type=plain_float, help="angular velocity after/before impact (default: Housner's)"
    )
    words = "side to which a wall opens, as something stands behind it; it needs a restitution (default: to both)"
    parser.add_argument("--opens", choices=("right", "left"), help=words)


def add_record(parser: argparse.ArgumentParser) -> None:
    """Add the record, and options for files that lack time step, unit or column."""
    parser.add_argument("record", nargs="?", help=f"{_KINDS} (default: the built-in record)")
    _add_description_and_scale(parser)


def add_records(parser: argparse.ArgumentParser) -> None:
    """Add any number of records, and options for files that lack time step, unit or column."""
    words = f"files, folders or patterns: {_KINDS} (default: the built-in record)"
    parser.add_argument("records", nargs="*", metavar="RECORD", help=words)
    parser.add_argument("--strict", action="store_true", help="stop at the first file that cannot be read")
    _add_description_and_scale(parser)


def _add_description_and_scale(parser: argparse.ArgumentParser) -> None:
    add_description(parser)
    parser.add_argument("--scale", type=plain_float, default=1.0, help="factor on the acceleration (default 1)")


def files_of(words: list[str]) -> list[str]:
    """Return the files, with patterns and folders expanded and sorted.

    Shells of Windows do not expand patterns. Of a folder it takes the files with endings of records, without those of
    its folders.

    **Raises:** ValueError for a pattern that matches no file, and a folder without such files.
    """
    found: list[str] = []
    for word in words:
        path = Path(word).expanduser()
        if path.is_dir():
            found += _files_in(path)
        elif path.exists() or not glob.has_magic(word):
            found.append(word)
        else:
            names = sorted(name for name in glob.glob(str(path)) if not Path(name).is_dir())
            if not names:
                raise ValueError(f"Pattern {word!r} matches no file.")
            found += names
    return found


def each_once(files: list[str]) -> list[str]:
    """Return the files without those that are there before, also by another path."""
    once: dict[str, str] = {}
    for name in files:
        once.setdefault(os.path.realpath(Path(name).expanduser()), name)
    return list(once.values())


def _files_in(folder: Path) -> list[str]:
    """Return the files of a folder that have endings of records, sorted."""
    files = [str(path) for path in _visible_in(folder) if path.suffix.lower() in _ENDINGS]
    if not files:
        raise ValueError(f"Folder {str(folder)!r} holds no file with an ending of records: {', '.join(_ENDINGS)}.")
    return files


def left_out_of_folders(words: list[str]) -> int:
    """Return the number of files, without hidden ones, that `files_of` leaves out of folders for their endings."""
    folders = {os.path.realpath(path) for path in (Path(word).expanduser() for word in words) if path.is_dir()}
    return sum(path.suffix.lower() not in _ENDINGS for folder in folders for path in _visible_in(Path(folder)))


def _visible_in(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.iterdir()) if not path.name.startswith(".") and not path.is_dir()]


def add_description(parser: argparse.ArgumentParser) -> None:
    """Add options for files that lack time step, unit or column."""
    parser.add_argument("--dt", type=plain_float, help="time between samples [s], for files that do not say")
    parser.add_argument("--unit", help="g, m/s2, cm/s2 or mm/s2, for files that do not say")
    parser.add_argument("--column", type=int, help="column of a CSV, or channel of a V1 or V2 file, from 0")
    parser.add_argument("--layout", help="rows (one series in reading order) or columns (a table), for text")


_OF_FILES = "dt", "unit", "column", "layout"


def file_description(arguments: argparse.Namespace) -> dict:
    """Return what options say of files, as arguments of `read_record`."""
    return {option: getattr(arguments, option) for option in _OF_FILES}


def record_of(arguments: argparse.Namespace) -> rk.Record:
    """Return the chosen record, scaled."""
    return scaled_record(arguments.record, arguments)


def scaled_record(path: str | None, arguments: argparse.Namespace) -> rk.Record:
    """Return the record of a file, or the built-in one, scaled."""
    if path is None:
        for option in _OF_FILES:
            if getattr(arguments, option) is not None:
                raise ValueError(f"Option --{option} describes a file, but no RECORD is given.")
        record = rk.example_record()
    else:
        record = rk.read_record(path, **file_description(arguments))
    if not abs(arguments.scale) < float("inf"):
        raise ValueError(f"Argument `--scale` must be finite, but is {arguments.scale:g}.")
    return rk.processing.scaled(record, arguments.scale)


def extent_of(pulse: type[AbstractPulse]) -> str:
    """Return the name of a pulse's second parameter, after the amplitude: "period" or "duration"."""
    return list(signature(pulse).parameters)[1]


def other_parameters(pulse: type[AbstractPulse]) -> dict[str, Any]:
    """Return the defaults of a pulse's parameters beyond amplitude and period or duration, by name.

    A parameter without a default has `Parameter.empty`.
    """
    more = list(signature(pulse).parameters.values())[2:]
    return {each.name: each.default for each in more if each.kind is not Parameter.KEYWORD_ONLY}  # leaves out `throw`


def add_pulse(parser: argparse.ArgumentParser) -> None:
    """Add options for the kind of pulse, and for all pulses' parameters beyond amplitude and period or duration."""
    parser.add_argument("--pulse", choices=tuple(PULSES), default="sine", help="shape of the pulse (default sine)")
    meant, kinds = {}, {}
    for word, pulse in PULSES.items():
        for name, default in other_parameters(pulse).items():
            default = 0.0 if default is Parameter.empty else default
            shown = default if isinstance(default, str) else "its own" if default is None else f"{default:g}"
            meant.setdefault(name, []).append(f"{word} (default {shown})")
            kinds[name] = str if isinstance(default, str) else plain_float
    for name, words in meant.items():
        parser.add_argument(option_of(name), type=kinds[name], help=f"of the pulse {', '.join(words)}")


def pulse_of(arguments: argparse.Namespace) -> Callable[..., AbstractPulse]:
    """Return the function that makes the pulse from amplitude [g] and period or duration [s]."""
    pulse = PULSES[arguments.pulse]
    parameters = other_parameters(pulse)
    fixed = {name: 0.0 for name, default in parameters.items() if default is Parameter.empty}
    for name in {name for each in PULSES.values() for name in other_parameters(each)}:
        value = getattr(arguments, name)
        if value is not None and name not in parameters:
            raise ValueError(f"Argument `{option_of(name)}` is not a parameter of the pulse {arguments.pulse}.")
        if value is not None:
            fixed[name] = value
    return partial(pulse, **fixed) if fixed else pulse


def option_of(name: str) -> str:
    """Return the name of an argument on the command line."""
    return "--" + name.replace("_", "-")


_INPUTS = ("record", "records", "rocks")
_POSITIONAL = {"command", *_INPUTS}


def inputs_of(arguments: argparse.Namespace) -> list[Path]:
    """Return the files that a command reads."""
    words = [getattr(arguments, name, None) or [] for name in _INPUTS]
    return [Path(path).expanduser() for each in words for path in ([each] if isinstance(each, str) else files_of(each))]


def as_typed(message: str, arguments: argparse.Namespace) -> str:
    """Rewrite a message of the package in terms of options: `dt` becomes `--dt`, and "is None" "is not given"."""
    options = vars(arguments).keys() - _POSITIONAL
    told = re.sub(r"`(\w+)`", lambda found: f"`{option_of(found[1])}`" if found[1] in options else found[0], message)
    return re.sub(r"^(Argument `--.*), but is None\.$", r"\1, but is not given.", told)


def check_points(points: int, least: int) -> None:
    """Raise ValueError for fewer points than `least`."""
    if points < least:
        raise ValueError(f"Argument `--points` must be at least {least}, but is {points}.")


def check_range(option: str, ends) -> None:
    """Raise ValueError unless both ends of a range are positive, finite and in order."""
    low, high = ends
    if not 0 < low <= high < float("inf"):
        raise ValueError(f"Argument `{option}` must be positive, finite and in order, but is {low:g} to {high:g}.")
