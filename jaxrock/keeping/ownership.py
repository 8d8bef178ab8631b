"""Folders and files that only their user can change: what is kept there runs as a part of the user's programs.

A folder is private where it belongs to the user (or to root) and only its owner may write in it, and where the same
holds on the way to it: a parent in which others may write lets them put another folder in its place.
"""

import functools
import os
import stat
import warnings
from collections.abc import Iterator
from pathlib import Path

from jaxrock._precision import frames_of_the_package

_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_PRIVATE = 0o700
_HAS_OWNERS = hasattr(os, "geteuid")  # Windows keeps others out of a user's folders by lists of access
_ALL_USERS = 2**32 - 1  # in the map of a process that lives in no user namespace of its own
_UNMAPPED = 65534  # the owner of what belongs to a user whom a container does not know


def private(*folders: Path, make: bool = False) -> bool:
    """Return whether folders are there and private; those that are the user's own are closed to others first.

    **Arguments:**

    - `folders`: each in the one before it, and none a link; links on the way to the first must belong to the user or
      to root.
    - `make`: whether they are made where they are missing, with their parents.

    Where they are there and not private, a warning says once why, and what to do.
    """
    try:
        there = next(each for each in folders[0].absolute().parents if each.exists())
        found = _parent_at_risk(there)  # before anything is made in what another user planted
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
    """Return whether a file, as its open descriptor tells of it, is a regular one that only its user could write."""
    return stat.S_ISREG(about.st_mode) and _is_trusted(about.st_uid) and not (_HAS_OWNERS and about.st_mode & _OTHERS)


def is_own_file(about: os.stat_result) -> bool:
    """Return whether a file is a regular one of the user's."""
    return stat.S_ISREG(about.st_mode) and (not _HAS_OWNERS or about.st_uid == os.geteuid())


@functools.cache
def warn_once(risk: str) -> None:
    """Warn that nothing is kept, and say what to do; once in a process for each reason."""
    warnings.warn(
        f"Compiled programs are not kept between sessions: {risk}. They would run with your rights. Let JAXROCK_CACHE "
        "name a folder of yours in which others cannot write, or say JAXROCK_CACHE=off.",
        RuntimeWarning,
        stacklevel=frames_of_the_package() + 1,
    )


def is_open(folder: Path) -> bool:
    """Return whether others than the owner of a folder may write in it; False where there is none."""
    try:
        return _HAS_OWNERS and bool(folder.lstat().st_mode & _OTHERS)
    except OSError:
        return False


def _make(folder: Path) -> None:
    """Make a folder and its parents, each for its user alone: what umask allows others is no matter."""
    for each in [*reversed(folder.absolute().parents), folder]:
        if not each.exists():
            each.mkdir(_PRIVATE, exist_ok=True)


def _risk(folder: Path) -> str | None:
    """Return why others may change what lies in a folder, else None; the user's own is closed to others first."""
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
    """Return why others may put something else in the place of what lies in a folder; None if they cannot."""
    for part in _way_to(folder) if _HAS_OWNERS else ():
        about = part.lstat()
        if not (_is_trusted(about.st_uid) or about.st_uid == _UNMAPPED and _is_mapped()):
            return f"{part}, on the way to them, belongs to another user"
        if not stat.S_ISLNK(about.st_mode) and _lets_others_rename(about):
            return f"others may write in {part}, where they lie"
    return None


def _way_to(folder: Path) -> Iterator[Path]:
    """Every folder and link that leads to a folder, from the root."""
    for part in [*reversed(folder.absolute().parents), folder.absolute()]:
        yield part
        if part.is_symlink():
            yield from _way_to(part.parent / os.readlink(part))


def _lets_others_rename(about: os.stat_result) -> bool:
    """Return whether others may rename what lies in a folder: not where it is sticky, as /tmp is."""
    if about.st_mode & stat.S_ISVTX:
        return False
    return bool(about.st_mode & stat.S_IWOTH or about.st_mode & stat.S_IWGRP and not _is_group_of_one(about.st_gid))


def _is_group_of_one(group: int) -> bool:
    """Return whether a group is the user's own, to which no other belongs."""
    import grp
    import pwd

    try:
        user, own = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:  # a container that knows no names
        return False
    if group != user.pw_gid or not set(own.gr_mem) <= {user.pw_name}:
        return False
    # A group that does not bear the user's name may be the first one of all users, who are no members by name then.
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
