"""The cache folder: any number of processes may read and write it, and damaged files are made again.

A file begins with a mark and a digest of its name and contents. It is written under a temporary name, and renamed: a
reader finds all of it or nothing. Its contents are run, so only private files (`ownership`) are read. When the folder
is too large, the least recently used files are removed first. Only files that the package made are replaced or removed:
regular ones of the user's, with the package's names and mark.
"""

import contextlib
import hashlib
import os
import re
import stat
import time
from pathlib import Path

import platformdirs

from jaxrock._core.atomic_files import written_atomically
from jaxrock.compiler.cache.ownership import is_own_file, is_private_file, private

LARGEST = 2**30  # bytes
KINDS = ("machine", "lowered")  # kinds of files of the package, each in a folder of its own
OF_JAX = "xla"  # the folder that JAX manages (see `enable`)
_OWN = "jaxrock-compiled"  # within a folder that the user names, which may hold other files
_OFF = ("off", "no", "none", "false", "0")
_MARK = b"jaxrock kept\n"
_DIGEST = hashlib.sha256().digest_size
_PATIENCE = 600  # seconds after which an unfinished file counts as abandoned
_NAME = re.compile(r"(jaxrock_)?[0-9a-f]{20,40}")
_UNFINISHED = re.compile(rf"\.({_NAME.pattern})\.[0-9a-f]{{32}}\.partial")
_NAME_OF_JAX = re.compile(r".+-[0-9a-f]{64}-(cache|atime)|\.lockfile|xla_gpu_\w+(/.+)?")
_DELETED_BY_JAX = re.compile(r"-(cache|atime)$")
_PLAINLY = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY", "O_CLOEXEC"))
_ANEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)


def folder() -> Path | None:
    """Return the cache folder: in the user's cache folder, or in that of JAXROCK_CACHE; None if that says `off`.

    A link may lead to a larger disk with other files: the cache is then a folder within the target.
    """
    said = os.environ.get("JAXROCK_CACHE", "").strip()
    if said.lower() in _OFF:
        return None
    place = Path(os.path.expanduser(said)) / _OWN if said else platformdirs.user_cache_path("jaxrock") / "compiled"
    return place / _OWN if place.is_symlink() else place


def folder_of(kind: str, make: bool = False) -> Path | None:
    """Return the folder of one kind of cached files; None where it is missing, or not private.

    **Arguments:**

    - `make`: whether to make a missing folder.
    """
    place = folder()
    return place / kind if place is not None and private(place, place / kind, make=make) else None


def name_of(*parts: object) -> str:
    """Return a file name for some texts: their digest."""
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:40]


def read(kind: str, name: str) -> bytes | None:
    """Return the contents cached under a name; None if they are missing, damaged, or open to other writers."""
    place = folder_of(kind)
    if place is None:
        return None
    path = place / name
    try:
        with open(os.open(path, _PLAINLY), "rb") as file:
            content = file.read() if is_private_file(os.fstat(file.fileno())) else b""
    except OSError:
        return None
    found = _verified(kind, name, content)
    if found is None:
        remove(path)
        return None
    with contextlib.suppress(OSError):  # the file may be read-only
        os.utime(path)
    return found


def write(kind: str, name: str, content: bytes) -> None:
    """Cache contents under a name; failure is ignored, as nothing depends on it."""
    place = folder_of(kind, make=True)
    if place is None:
        return
    path = place / name
    try:
        if os.path.lexists(path) and not _is_made(path):
            return
        with (
            written_atomically(path, replace=True, lasting=False) as aside,
            open(os.open(aside, _ANEW, 0o600), "wb") as file,
        ):
            file.write(_MARK + _digest(kind, name, content) + content)
    except OSError:
        return
    with contextlib.suppress(OSError):  # another process may be deleting the folder
        prune(LARGEST)


def _digest(kind: str, name: str, content: bytes) -> bytes:
    """Return the digest of contents and name, so that a file under another name does not pass."""
    return hashlib.sha256(f"{kind}/{name}\n".encode() + content).digest()


def _verified(kind: str, name: str, content: bytes) -> bytes | None:
    """Return the contents of a file, with or without a mark; None if it is damaged, or was not made by the package."""
    content = content.removeprefix(_MARK)
    return content[_DIGEST:] if content[:_DIGEST] == _digest(kind, name, content[_DIGEST:]) else None


def _is_made(path: Path) -> bool:
    """Return whether the package made a file: by its owner and its mark, or by its digest.

    A file that is empty, or begins with zeros, is left by a power loss, and holds nothing.
    """
    try:
        with open(os.open(path, _PLAINLY), "rb") as file:
            if not is_own_file(os.fstat(file.fileno())):
                return False
            head = file.read(len(_MARK))
            if head == _MARK or not head.strip(b"\0"):
                return True
            return _verified(path.parent.name, path.name, head + file.read()) is not None
    except OSError:
        return False


def remove(path: Path) -> None:
    """Remove a cached file, if the package made it, or JAX did."""
    if path.parent.name not in KINDS or _is_made(path):
        with contextlib.suppress(OSError):  # another process may have removed it
            path.unlink()


def prune(largest: int) -> None:
    """Delete what has not been used for longest, until the rest has `largest` bytes at most."""
    found = []
    for path, about in (each for kind in KINDS for each in _of_package(kind)):
        if not path.name.startswith("."):
            found.append((about.st_mtime, about.st_size, path))
        elif time.time() - about.st_mtime > _PATIENCE:
            remove(path)
    size = sum(each for _, each, _ in found)
    for _, each, path in sorted(found):
        if size <= largest:
            return
        size -= each
        remove(path)


def _of_package(kind: str) -> list[tuple[Path, os.stat_result]]:
    """Return the user's regular files with the package's names in the folder of a kind."""
    place, found = folder_of(kind), []
    if place is None:
        return found
    for entry in os.scandir(place):
        with contextlib.suppress(OSError):  # another process may have removed it
            named = _NAME.fullmatch(entry.name) or _UNFINISHED.fullmatch(entry.name)
            if named and is_own_file(about := entry.stat(follow_symlinks=False)):
                found.append((place / entry.name, about))
    return found


def of_jax() -> tuple[list[Path], list[Path]]:
    """Return the files in JAX's folder: those that JAX made for the user, and those that it must not read.

    The latter are links, files of other users, and files with other names that JAX would delete as its own.
    """
    made, others, place = [], [], folder_of(OF_JAX)
    if place is None:
        return made, others
    for at, folders, files in os.walk(place):
        for path in [Path(at) / name for name in (*files, *folders)]:
            with contextlib.suppress(FileNotFoundError):  # another process may have removed it
                about = path.lstat()
                if is_own_file(about) and _NAME_OF_JAX.fullmatch(path.relative_to(place).as_posix()):
                    made.append(path)
                elif not stat.S_ISDIR(about.st_mode) and (not is_own_file(about) or _DELETED_BY_JAX.search(path.name)):
                    others.append(path)
    return made, others


def files() -> list[Path]:
    """Return all files of the folder that the package or JAX made."""
    own = [path for kind in KINDS for path, _ in _of_package(kind) if _is_made(path)]
    return own + of_jax()[0]


def clear() -> None:
    """Delete the cached files, and the folders that are then empty."""
    for path in files():
        remove(path)
    for kind in (*KINDS, OF_JAX):
        place = folder_of(kind)
        for each in [*(place.glob("xla_gpu_*") if place is not None else ()), place]:
            with contextlib.suppress(OSError):  # the folder holds other files
                if each is not None:
                    each.rmdir()


def is_program(path: Path) -> bool:
    """Return whether a cached file holds a program; JAX keeps a time of last use beside each of its own."""
    return path.parent.name != OF_JAX or path.name.endswith("-cache")
