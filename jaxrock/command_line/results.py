"""The folder of results: it identifies the files that the command wrote there, and replaces no others.

One file beside the results lists their SHA-256. A line is added before a result gets its name, and none is removed. So
concurrent or killed runs in one folder recognise each other's results. A result that was changed later no longer counts
as the command's own.
"""

import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from jaxrock._core.atomic_files import move_into_place

HASH_FILE = ".jaxrock.sha256"
_TITLE = "# Files that jaxrock wrote here, by their SHA-256: these it replaces, all others with --force only."


class ResultFolder:
    """A folder of results, which may not exist yet.

    - `inputs`: files that the command reads.
    - `force`: whether to replace inputs, and files that the command did not make.
    """

    def __init__(self, path: Path, inputs: Iterable[Path] = (), force: bool = False):
        self.path, self._inputs, self._force = path, list(inputs), force

    def check(self, names: Iterable[str]) -> None:
        """Check that files may be written.

        **Raises:** FileExistsError where they would replace an input, a foreign file, or a result that was changed
        later.
        """
        found = [f"{self.path / name} {risk}" for name in names if (risk := self._risk(self.path / name))]
        if not self._is_list_own():
            found.append(f"{self.path / HASH_FILE} is not jaxrock's")
        if found:
            raise FileExistsError(
                f"Argument `--out` must be a folder whose files may be replaced, but {'; '.join(found)}. Give another "
                "--out, or --force to replace files."
            )

    @contextlib.contextmanager
    def whole(self, name: str) -> Iterator[Path]:
        """Yield a temporary path for a file, which gets its name when the body ends; errors name the file."""
        path = self.path / name
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            aside = Path(tempfile.mkdtemp(".partial", f".{name}.", self.path))
            try:
                yield aside / name
                self.check([name])  # another program may have created the file since the first check
                self._note(name, _digest(aside / name))
                move_into_place(aside / name, path, replace=os.path.lexists(path))
            finally:
                shutil.rmtree(aside, ignore_errors=True)
        except FileExistsError:
            raise
        except OSError as error:
            raise OSError(f"{path} cannot be written: {error.strerror or error}") from error

    def discard(self, name: str) -> None:
        """Remove the result of an earlier run, if it is unchanged."""
        path = self.path / name
        if self._is_own(path):
            path.unlink()

    def _risk(self, path: Path) -> str | None:
        """Return why a file must not be replaced, else None."""
        if not os.path.lexists(path):
            return None
        if path.is_dir() and not path.is_symlink():
            return "is a folder"
        if self._force or self._is_own(path) and not self._is_input(path):
            return None
        return "is an input" if self._is_input(path) else "was not made by jaxrock, or was changed since"

    def _is_input(self, path: Path) -> bool:
        """Return whether a path is one of the inputs, by any name or link."""
        return any(path.exists() and each.exists() and path.samefile(each) for each in self._inputs)

    def _is_own(self, path: Path) -> bool:
        """Return whether a file is unchanged since the command wrote it."""
        if not path.is_file() or path.is_symlink() or not self._is_list_own():
            return False
        return f"{_digest(path)}  {path.name}" in self._told().splitlines()

    def _is_list_own(self) -> bool:
        known = self.path / HASH_FILE
        return not os.path.lexists(known) or not known.is_symlink() and self._told().startswith(_TITLE)

    def _told(self) -> str:
        known = self.path / HASH_FILE
        return known.read_text(encoding="utf-8", errors="replace") if known.is_file() else ""

    def _note(self, name: str, digest: str) -> None:
        """Append a new line to the list, in one write."""
        told, line = self._told(), f"{digest}  {name}"
        if line in told.splitlines():
            return
        start = "" if told.endswith("\n") else "\n" if told else f"{_TITLE}\n"  # a full disk may have cut the last line
        with open(self.path / HASH_FILE, "a", encoding="utf-8", opener=_opened) as file:
            file.write(f"{start}{line}\n")


def _opened(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
