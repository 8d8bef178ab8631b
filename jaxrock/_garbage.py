"""Python's garbage collector, kept quiet where it only costs time."""

import contextlib
import gc
import threading

_lock = threading.Lock()
_pauses = []  # one entry for each that goes on now, in any thread: whether the collector was on before


@contextlib.contextmanager
def not_collected():
    """Pause the collector.

    Tracing a program makes hundreds of thousands of objects, of which nearly none is garbage: to look for it again and
    again takes a third of the time.
    """
    with _lock:
        _pauses.append(_pauses[0] if _pauses else gc.isenabled())
        gc.disable()
    try:
        yield
    finally:
        with _lock:
            was_on = _pauses.pop()
            if was_on and not _pauses:
                gc.enable()
