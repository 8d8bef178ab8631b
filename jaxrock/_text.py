"""Text files as they come: their lines, and errors that name the file."""

import re
from pathlib import Path


def file_error(name: str, text: str) -> ValueError:
    """What to raise for a file that is wrong."""
    return ValueError(f"File `{name}`: {text}")


def text_lines(path: Path) -> list[str]:
    """The lines of a text file, without their ends."""
    data = path.read_bytes()
    # Files from DOS end in bytes 26, which are no text but no damage either.
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
