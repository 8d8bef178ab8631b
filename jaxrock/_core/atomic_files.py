"""Atomic writing of files and folders: they are written under a temporary name, and renamed."""

import _thread
import contextlib
import errno
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_ATTEMPTS, _BETWEEN = 40, 0.05  # attempts to remove a temporary file; seconds between them


@contextlib.contextmanager
def written_atomically(path: Path, *, replace: bool = False, lasting: bool = True) -> Iterator[Path]:
    """Yield a temporary path; rename it to `path` when the body ends, and remove it when the body fails.

    **Arguments:**

    - `replace`: whether to replace an existing file, or the file that a link leads to.
    - `lasting`: whether to flush it to disk before the rename, so that it survives a power loss.

    **Raises:** FileExistsError where `path` exists, unless `replace`; IsADirectoryError; FileNotFoundError where the
    folder is missing; OSError for an existing path that is not a regular file, such as a device.
    """
    if replace and path.exists():
        _check_replaced(path)
    if replace and path.is_symlink():
        path = path.resolve()
    if not path.name:  # the root or the current folder
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not path.parent.exists():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
    aside = path.with_name(f".{path.name[:64]}.{uuid.uuid4().hex}.partial")
    try:
        yield aside
        if lasting:
            for file in [aside, *aside.rglob("*")]:
                _reach_the_disk(file)
        move_into_place(aside, path, replace)
        if lasting:
            _reach_the_disk(path.parent)
    finally:
        _remove(aside)


def _check_replaced(path: Path) -> None:
    """Raise OSError for a path that is not a regular file; root could replace even a device."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not path.is_file():
        raise OSError(errno.EINVAL, "Only regular files are replaced", str(path))


def _remove(aside: Path) -> None:
    """Remove a temporary file or folder, also while a thread of an interrupted library still writes to it."""
    for _ in range(_ATTEMPTS):
        if aside.is_dir():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                aside.unlink(missing_ok=True)
        if not aside.exists():
            return
        time.sleep(_BETWEEN)


def _reach_the_disk(file: Path) -> None:
    if file.is_dir() and os.name == "nt":  # Windows cannot open folders
        return
    handle = os.open(file, os.O_RDWR if os.name == "nt" else os.O_RDONLY)  # Windows flushes only what it may write
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def move_into_place(aside: Path, path: Path, replace: bool) -> None:
    """Rename a finished file or folder to its final name.

    **Raises:** FileExistsError where the name is taken, unless `replace`.
    """
    if replace:
        os.replace(aside, path)
    elif aside.is_dir():
        try:
            os.rename(aside, path)  # fails where the name is taken, unless by an empty folder
        except OSError as error:
            raise _taken(path) if path.exists() else error from error
    else:
        try:
            os.link(aside, path)  # fails where the name is taken; a rename would replace it
        except FileExistsError as error:
            raise _taken(path) from error
        except OSError as error:  # a file system without links
            if path.exists():
                raise _taken(path) from error
            os.rename(aside, path)


def _taken(path: Path) -> FileExistsError:
    return FileExistsError(f"{path} was made by somebody else meanwhile.")


def uninterrupted(function: Callable, *given: Any, stop: Callable[[], None] = lambda: None) -> Any:
    """Call a function to its end despite interrupts: the caller waits for it, and then raises the interrupt.

    The function runs in a thread of its own, as interrupts reach the main thread only. Libraries in C, and those with
    threads, go on writing after an exception, or cannot close their files. Code that cleans up after an exception can
    be interrupted, too.

    **Arguments:**

    - `stop`: called if an interrupt comes while the function is running.
    """
    # `threading` is written in Python, so that an interrupt within it breaks its locks; `_thread` is written in C.
    whose, done = _thread.allocate_lock(), _thread.allocate_lock()
    found: list[tuple[Any, BaseException | None]] = []

    def run():
        if whose.acquire(blocking=False):
            try:
                found.append((function(*given), None))
            except BaseException as error:
                found.append((None, error))
            finally:
                done.release()

    done.acquire()
    try:
        _thread.start_new_thread(run, ())
        done.acquire()
    except BaseException:
        if not whose.acquire(blocking=False):  # the function has begun; otherwise it never starts
            stop()
            _wait(done, found)
        raise
    result, error = found[0]
    if error is not None:
        raise error
    return result


def _wait(done: _thread.LockType, found: list) -> None:
    while not found:  # also if the user interrupts again
        with contextlib.suppress(KeyboardInterrupt):
            done.acquire(timeout=_BETWEEN)
