"""What Python does by the way, kept away where programs are traced: its collector, and memory for its frames."""

import contextlib
import functools
import gc
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")
_lock = threading.Lock()
_pauses = []  # one entry for each that goes on now, in any thread: whether the collector was on before
_WORDS = 2**17  # of the frame that makes room for others: as many more are left for them, 1 MB


def undisturbed(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The same function, which Python's garbage collector and stack leave alone while it runs."""

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _not_collected():
            return with_room(function, *args, **kwargs)

    return called


@contextlib.contextmanager
def _not_collected():
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


def with_room(function, /, *args, **kwargs):
    """Call a function whose frames, and those of all that it calls, find room in one piece of memory.

    CPython keeps frames in pieces of 16 kB, and asks the system for the next one, and gives it back, at every call and
    return across the end of a piece (until 2026, gh-142183). Where a loop stands next to one, that is done at every
    turn, ten thousand times before a first answer. A frame that asks for much gets a piece with as much room again; it
    asks by the size of its own stack, of which nothing is touched, so that the room takes no memory before it is used.
    Within another that has less left it gets a piece of its own. What it is worth: `benchmarks/frames.py`.
    """
    return function(*args, **kwargs)


with_room.__code__ = with_room.__code__.replace(co_stacksize=_WORDS)
