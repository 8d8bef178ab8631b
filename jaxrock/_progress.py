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

    def update(self, done: int) -> None:
        """Draw the bar at `done`."""
        spent = time.monotonic() - self.begun
        if not self.shown or (spent < 1 and not self.forced):
            return
        filled = 30 * done // self.total
        left = spent * (self.total - done) / max(done, 1)
        end = "\n" if done >= self.total else ""
        bar = "#" * filled + "." * (30 - filled)
        sys.stderr.write(f"\r{self.label} [{bar}] {done:,}/{self.total:,}  {left:5.0f} s left{end}")
        sys.stderr.flush()
