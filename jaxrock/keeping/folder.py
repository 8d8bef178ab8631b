"""The folder of what is kept: any number of processes may read and write it, and what is damaged is made again.

A file begins with a digest of its name and the rest, is written aside, and renamed: a reader finds all of it or
nothing. When the folder has grown too large, what has not been used for longest goes first.
"""

import contextlib
import hashlib
import os
import time
from pathlib import Path

import platformdirs

from jaxrock._aside import written_aside

LARGEST = 2**30  # bytes
_OWN = "jaxrock-compiled"  # within a folder that the user names, where other things may lie: all of this may be deleted
OF_JAX = "xla"  # the part that JAX looks after (see `compiled`)
_OFF = ("off", "no", "none", "false", "0")
_DIGEST = hashlib.sha256().digest_size
_PATIENCE = 600  # seconds after which a file that was never finished is nobody's


def folder() -> Path | None:
    """Where things are kept: in the user's cache folder, or in the one of JAXROCK_CACHE; None if that says `off`."""
    said = os.environ.get("JAXROCK_CACHE", "").strip()
    if said.lower() in _OFF:
        return None
    return Path(os.path.expanduser(said)) / _OWN if said else platformdirs.user_cache_path("jaxrock") / "compiled"


def name_of(*parts: object) -> str:
    """A name for what is told by some texts."""
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:40]


def read(kind: str, name: str) -> bytes | None:
    """What is kept under a name; None if it is not there, or damaged."""
    place = folder()
    if place is None:
        return None
    path = place / kind / name
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if content[:_DIGEST] != _digest(kind, name, content[_DIGEST:]):
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    with contextlib.suppress(OSError):  # it may be read-only
        os.utime(path)
    return content[_DIGEST:]


def write(kind: str, name: str, content: bytes) -> None:
    """Keep something under a name, if that can be done: nothing depends on it."""
    place = folder()
    if place is None:
        return
    try:
        (place / kind).mkdir(parents=True, exist_ok=True)
        with written_aside(place / kind / name, replace=True, lasting=False) as aside:
            aside.write_bytes(_digest(kind, name, content) + content)
    except OSError:
        return
    with contextlib.suppress(OSError):  # somebody may be deleting all of it
        prune(LARGEST)


def _digest(kind: str, name: str, content: bytes) -> bytes:
    """Of a file and its name: another's content is not taken for it."""
    return hashlib.sha256(f"{kind}/{name}\n".encode() + content).digest()


def prune(largest: int) -> None:
    """Delete what has not been used for longest, until the rest has `largest` bytes at most."""
    found = []
    for path in kept():
        with contextlib.suppress(OSError):  # another process may have been faster
            about = path.stat()
            if path.parent.name == OF_JAX:
                continue
            if not path.name.startswith("."):
                found.append((about.st_mtime, about.st_size, path))
            elif time.time() - about.st_mtime > _PATIENCE:
                path.unlink()
    size = sum(each for _, each, _ in found)
    for _, each, path in sorted(found):
        if size <= largest:
            return
        size -= each
        with contextlib.suppress(OSError):
            path.unlink()


def kept() -> list[Path]:
    """All files of the folder."""
    place = folder()
    if place is None or not place.is_dir():
        return []
    return [path for path in place.rglob("*") if path.is_file()]
