"""The choice, by thread, between raising for numbers outside of their ranges and turning them into NaN."""

import contextlib
import contextvars
from collections.abc import Iterator

# True: numbers outside of their ranges raise; False: they become NaN. Each thread has its own value.
_throws = contextvars.ContextVar("throws", default=True)


@contextlib.contextmanager
def throwing(wanted: bool) -> Iterator[None]:
    """Let numbers outside of their ranges, concrete or traced, raise within the body if `wanted`; else they become NaN.

    Within a body that does not raise, an inner one does not raise either. Functions that JAX traces and caches must not
    run in the body: JAX would reuse programs without these checks.
    """
    before = _throws.set(_throws.get() and wanted)
    try:
        yield
    finally:
        _throws.reset(before)


def throws() -> bool:
    """Return whether numbers outside of their ranges raise now."""
    return _throws.get()
