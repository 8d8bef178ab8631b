"""A progress bar of one line on the error stream; silent where nobody watches."""

import sys
import time


class Progress:
    """Draw `done` of `total`; where `shown` is None, only on a terminal, and only if the work takes over a second."""

    def __init__(self, total: int, label: str, shown: bool | None = None):
        self.total, self.label = total, label
        self.shown = sys.stderr.isatty() if shown is None else shown
        self.forced = bool(shown)
        self.begun = time.monotonic()
        self.done = 0

    def add(self, more: int) -> None:
        """Draw the bar with some more done."""
        self.done += more
        spent = time.monotonic() - self.begun
        if not self.shown or (spent < 1 and not self.forced):
            return
        filled = 30 * self.done // self.total
        left = spent * (self.total - self.done) / max(self.done, 1)
        end = "\n" if self.done >= self.total else ""
        bar = "#" * filled + "." * (30 - filled)
        sys.stderr.write(f"\r{self.label} [{bar}] {self.done:,}/{self.total:,}  {left:5.0f} s left{end}")
        sys.stderr.flush()
