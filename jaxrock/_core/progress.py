"""A progress bar, by tqdm: on a terminal and in a notebook, if the work takes over a second; silent elsewhere."""

import sys
import warnings
from typing import Any


class Progress:
    """Show `done` of `total`. If `shown` is None: only on a terminal or in a notebook, and only after a second."""

    def __init__(self, total: int, label: str, shown: bool | None = None):
        self.total, self.done, self.bar = total, 0, None
        if total > 0 and (_is_watched() if shown is None else shown):
            self.bar = _kind()(total=total, desc=label, delay=0 if shown else 1)

    def add(self, more: int) -> None:
        """Show the bar with some more done."""
        self.done += more
        if self.bar is not None:
            self.bar.update(more)
            if self.done >= self.total:
                self.bar.close()


def _is_watched() -> bool:
    """Return whether standard error is a terminal, or this is a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return sys.stderr.isatty() or "IPKernelApp" in getattr(shell, "config", ())


def _kind() -> Any:
    with warnings.catch_warnings():  # without widgets, a notebook shows a bar of characters
        warnings.simplefilter("ignore")
        from tqdm.auto import tqdm

    class Bar(tqdm):
        monitor_interval = 0  # no thread that watches the bar

    return Bar
