"""Lines of text files in any usual encoding, and errors that name the file."""

import os
import re
import warnings
from pathlib import Path

from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.regular_files import open_regular

_LARGEST = 2**30  # bytes; the lines take several times as much memory
_MANY = 50  # numbers whose format is compared


def file_error(name: str, text: str) -> ValueError:
    """Return the error for an invalid file."""
    return ValueError(f"File `{name}`: {text}")


def line_error(name: str, number: int, told: str, line: str) -> ValueError:
    """Return the error for a wrong line, which the message shows."""
    return file_error(name, f"line {number} {told} {line.strip()[:60]!r}.")


def check_end(name: str, lines: list[str], numbers: list[str], by_program: bool = False) -> None:
    """Raise ValueError where a file was likely cut within its last number, and warn where it may have been.

    The file is whole if a line end or a separator follows that number. It is whole, too, if the number is printed as
    all others are, with as many digits after the point and as long an exponent. It was likely cut if the number is
    shorter than all others in its column.

    **Arguments:**

    - `numbers`: as printed in the file; or only their last column.
    - `by_program`: whether a program printed all numbers in one format. The last number must then have it, even before
      a line end.
    """
    if len(numbers) > _MANY:
        numbers = [*numbers[:_MANY], *numbers[-2:]]
    *before, last = map(_shape, numbers)
    alike = len(before) > 1 and len(set(before)) == 1 and before[0] != (0, 0)
    ended = not lines[-1].strip() or "#" in lines[-1]
    ended = ended or bool(numbers[-1].strip()) and not re.search(r"[\d.]$", lines[-1])
    if alike and last != before[0] and (by_program or not ended):
        raise file_error(name, f"the last number, {numbers[-1]!r}, is not printed as all others: the file is cut off.")
    if ended or alike:
        return
    told = f"line {len(lines)} ends without a line end"
    if not before or _has_fewer_digits(last, before) or _is_shorter(lines):
        short = f"its last number, {numbers[-1].strip()!r}, is shorter than all others in its column"
        short = short if before else "it holds a single number"
        raise file_error(name, f"{told}, and {short}: it may be cut off; add a line end if it is not.")
    warnings.warn(
        f"File `{name}`: {told}, so that its last number, {numbers[-1].strip()!r}, may be cut off: "
        "add a line end if it is not.",
        stacklevel=frames_of_the_package() + 1,
    )


def _has_fewer_digits(last: tuple[int, int], before: list[tuple[int, int]]) -> bool:
    """Return whether a number has fewer digits after the point, or of its exponent, than all others."""
    exponents = [each[1] for each in before if each[1] or not last[1]]
    return last[0] < min(each[0] for each in before) or bool(exponents) and last[1] < min(exponents)


_FIELD = re.compile(r"[^\s,;]+")
_OF_NUMBERS = re.compile(r"[-+.\dEeDd\s,;]*\d[-+.\dEeDd\s,;]*")


def _is_shorter(lines: list[str]) -> bool:
    """Return whether the last number ends before the place where all others of its column end."""
    rows = [line for line in lines[-_MANY:] if _OF_NUMBERS.fullmatch(line)]
    ends = [[field.end() for field in _FIELD.finditer(line)] for line in rows]
    column = len(ends[-1]) - 1 if ends else 0
    places = {each[column] for each in ends[:-1] if len(each) > column}
    return len(ends) > 2 and len(places) == 1 and ends[-1][column] < min(places)


def _shape(text: str) -> tuple[int, int]:
    """Return the number of digits after the point, and of characters of the exponent."""
    mantissa, exponent, power = text.strip().upper().replace("D", "E").partition("E")
    return len(mantissa.partition(".")[2]), len(exponent + power)


def text_lines(path: Path) -> list[str]:
    """Return the lines of a text file, without line ends.

    **Raises:** OSError if it cannot be opened; ValueError for a file that is not regular, not text, empty or too large.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > _LARGEST:
            told = f"holds {size / 2**30:.3g} GiB, but of text at most 1 GiB is read"
            raise file_error(path.name, f"{told}: cut it, or make a `Record` of its samples.")
        data = file.read()
    # DOS files end in bytes 26, which are no text, but harmless.
    data = data.replace(b"\x1a", b"")
    if re.search(rb"[\x00-\x08\x0e-\x1f]", data):
        raise file_error(path.name, "is not plain text: it is binary, or in an encoding such as UTF-16.")
    if not data.strip():
        raise file_error(path.name, "is empty.")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # place names in old headers
    # Not str.splitlines, which also breaks at form feeds and others, and so would count lines wrongly.
    return re.split(r"\r\n|\r|\n", text)
