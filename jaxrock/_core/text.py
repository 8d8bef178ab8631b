"""Lines of text files in any usual encoding, and errors that name the file."""

import os
import re
from pathlib import Path

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
    """Raise ValueError where a file may have been cut within its last number.

    The file is whole if a line end follows that number. It is whole, too, if the number is printed as all others are,
    with as many digits after the point and as long an exponent.

    **Arguments:**

    - `numbers`: as printed in the file; or only their last column.
    - `by_program`: whether a program printed all numbers in one format. The last number must then have it, even before
      a line end.
    """
    if len(numbers) > _MANY:
        numbers = [*numbers[:_MANY], *numbers[-2:]]
    *before, last = map(_shape, numbers)
    alike = len(before) > 1 and len(set(before)) == 1 and before[0] != (0, 0)
    ended = not lines[-1].strip()
    if alike and last != before[0] and (by_program or not ended):
        raise file_error(name, f"the last number, {numbers[-1]!r}, is not printed as all others: the file is cut off.")
    if not ended and not alike:
        raise file_error(name, "ends without a line end, so that its last number may be cut off: add one if it is not.")


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
