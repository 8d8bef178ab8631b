"""Folders and files that only their user can change: cached code runs as a part of the user's programs.

A folder is private where it belongs to the user (or to root) and only its owner may write in it. The same must hold for
its parents: a writable parent lets other users put another folder in its place.
"""

import functools
import os
import stat
import warnings
from collections.abc import Iterator
from pathlib import Path

from jaxrock._core.precision import frames_of_the_package

_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_PRIVATE = 0o700
_HAS_OWNERS = hasattr(os, "geteuid")  # Windows protects a user's folders by access lists
_ALL_USERS = 2**32 - 1  # identity map of a process outside of any user namespace
_UNMAPPED = 65534  # owner of files of users that a container does not know


def private(*folders: Path, make: bool = False) -> bool:
    """Return whether folders exist and are private; folders of the user's own are first closed to others.

    **Arguments:**

    - `folders`: each in the one before it, and no links. Links on the way to the first must belong to the user or to
      root.
    - `make`: whether to make missing folders, with their parents.

    Where they exist and are not private, a warning says once why, and names the remedy.
    """
    try:
        there = next(each for each in folders[0].absolute().parents if each.exists())
        if not there.is_dir():  # JAXROCK_CACHE=/dev/null switches the cache off
            return False
        found = _parent_at_risk(there)  # checked before anything is made below a folder that another user planted
        if found is None and make:
            _make(folders[-1])
        if found is None and not folders[-1].exists():
            return False
        found = found or next(filter(None, map(_risk, folders)), None)
    except OSError:
        return False
    if found is not None:
        warn_once(found)
    return found is None


def is_private_file(about: os.stat_result) -> bool:
    """Return whether an open file's status shows a regular file that only its user could write."""
    return stat.S_ISREG(about.st_mode) and _is_trusted(about.st_uid) and not (_HAS_OWNERS and about.st_mode & _OTHERS)


def is_own_file(about: os.stat_result) -> bool:
    """Return whether a file is a regular one of the user's."""
    return stat.S_ISREG(about.st_mode) and (not _HAS_OWNERS or about.st_uid == os.geteuid())


@functools.cache
def warn_once(risk: str) -> None:
    """Warn that nothing is cached, with the remedy; once in a process for each reason."""
    warnings.warn(
        f"Compiled programs are not kept between sessions: {risk}. They would run with your rights. Let JAXROCK_CACHE "
        "name a folder of yours in which others cannot write, or set JAXROCK_CACHE=off.",
        RuntimeWarning,
        stacklevel=frames_of_the_package() + 1,
    )


def is_open(folder: Path) -> bool:
    """Return whether users other than the owner may write in a folder; False where it is missing."""
    try:
        return _HAS_OWNERS and bool(folder.lstat().st_mode & _OTHERS)
    except OSError:
        return False


def _make(folder: Path) -> None:
    """Make a folder and its parents, each for its user alone, independent of umask."""
    for each in [*reversed(folder.absolute().parents), folder]:
        if not each.exists():
            each.mkdir(_PRIVATE, exist_ok=True)


def _risk(folder: Path) -> str | None:
    """Return why others may change the contents of a folder, else None; the user's own is first closed to others."""
    if folder.is_symlink():
        return f"{folder} is a link"
    if not _HAS_OWNERS:
        return None if folder.is_dir() else f"{folder} is no folder"
    handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
    try:
        about = os.fstat(handle)
        if not _is_trusted(about.st_uid):
            return f"{folder} belongs to another user"
        if about.st_uid == os.geteuid() and stat.S_IMODE(about.st_mode) & 0o077:
            os.fchmod(handle, _PRIVATE)
        if os.fstat(handle).st_mode & _OTHERS:
            return f"others may write in {folder}"
    finally:
        os.close(handle)
    return None


def _parent_at_risk(folder: Path) -> str | None:
    """Return why others may replace an entry of a folder, else None."""
    for part in _way_to(folder) if _HAS_OWNERS else ():
        about = part.lstat()
        if not (_is_trusted(about.st_uid) or about.st_uid == _UNMAPPED and _is_mapped()):
            return f"{part}, on the way to them, belongs to another user"
        if not stat.S_ISLNK(about.st_mode) and _lets_others_rename(about):
            return f"others may write in {part}, where they lie"
    return None


def _way_to(folder: Path) -> Iterator[Path]:
    """Yield every folder and link on the path to a folder, from the root."""
    for part in [*reversed(folder.absolute().parents), folder.absolute()]:
        yield part
        if part.is_symlink():
            yield from _way_to(part.parent / os.readlink(part))


def _lets_others_rename(about: os.stat_result) -> bool:
    """Return whether others may rename entries of a folder; a sticky folder, such as /tmp, forbids it."""
    if about.st_mode & stat.S_ISVTX:
        return False
    return bool(about.st_mode & stat.S_IWOTH or about.st_mode & stat.S_IWGRP and not _is_group_of_one(about.st_gid))


def _is_group_of_one(group: int) -> bool:
    """Return whether a group is the user's own, without other members."""
    import grp
    import pwd

    try:
        user, own = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:  # a container may know no names
        return False
    if group != user.pw_gid or not set(own.gr_mem) <= {user.pw_name}:
        return False
    # A group without the user's name may be the primary group of all users, whom it does not list as members.
    return own.gr_name == user.pw_name or [each.pw_name for each in pwd.getpwall() if each.pw_gid == group] == [
        user.pw_name
    ]


def _is_trusted(owner: int) -> bool:
    """Return whether an owner is the user, or root, who can change everything anyway."""
    return not _HAS_OWNERS or owner in (0, os.geteuid())


@functools.cache
def _is_mapped() -> bool:
    """Return whether this process lives in a user namespace that does not know all users, as containers do."""
    try:
        told = Path("/proc/self/uid_map").read_text().split()
    except OSError:
        return False
    return _ALL_USERS not in map(int, told[2::3])
