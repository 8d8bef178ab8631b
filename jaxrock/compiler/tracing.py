"""Tracing without two costs of Python: garbage collections, and allocations of memory for frames."""

import contextlib
import functools
import gc
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")
_lock = threading.Lock()
_pauses = []  # one for each pause now, in any thread: whether the collector was on before
_WORDS = 2**17  # stack size of the frame that makes room: as many words, 1 MB, are left for other frames


def while_tracing(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function that traces: it runs without garbage collections, and with room for its frames."""

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _not_collected():
            return with_stack(function, *args, **kwargs)

    return called


@contextlib.contextmanager
def _not_collected():
    """Pause the garbage collector.

    Tracing makes hundreds of thousands of objects, of which hardly any is garbage. Collections would take a third of
    the time.
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


def with_stack(function, /, *args, **kwargs):
    """Call a function, with one chunk of memory for its frames and those of all that it calls.

    CPython keeps frames in chunks of 16 kB. It allocates a chunk at every call across the end of one, and frees it at
    the return (until 2026, gh-142183). A loop at the end of a chunk does so in every iteration: ten thousand times
    before a first result.

    A frame with a large stack gets a chunk with as much room again. This function declares such a stack, and leaves it
    untouched, so that the room takes no memory before it is used. Within a chunk with too little room it gets a new
    one. `benchmarks/frames.py` measures the gain.
    """
    return function(*args, **kwargs)


with_stack.__code__ = with_stack.__code__.replace(co_stacksize=_WORDS)
