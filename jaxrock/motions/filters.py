"""Butterworth filters of samples, and what they take to lie beyond both ends.

NumPy and SciPy: `processing` uses them.
"""

from collections.abc import Callable

import numpy as np
import scipy.signal

ROOM = 8  # in lengths of what is filtered: beyond either end no more, unless that is little
LOWEST = 1e-6  # corner over sampling rate: of lower ones coefficients of filters lose their digits, and at last all


def smoothed(values: np.ndarray, dt: float, corner: float | None, order: int, beyond: Callable) -> np.ndarray:
    """After a low-pass without delay; `beyond(values, room)`: with so many more at either end."""
    return values if corner is None else butterworth(values, dt, None, corner, order, True, beyond)


def at_rest(values: np.ndarray, room: int) -> np.ndarray:
    """Rest before and after."""
    return np.pad(values, room)


def evenly(values: np.ndarray, room: int) -> np.ndarray:
    """Mirrored at both ends."""
    last = values.size - 1
    place = np.abs(np.arange(-room, values.size + room)) % (2 * last)
    return values[np.minimum(place, 2 * last - place)]


# What a ground at rest at first does, mirrored in time before it begins, and turned about its end after it. A mirror
# image keeps the velocity at zero under a filter without delay; if the ground only rested before, it would jump.


def of_displacement(values: np.ndarray, room: int) -> np.ndarray:
    last = values.size - 1
    turns, place = np.divmod(np.abs(np.arange(-room, values.size + room)), 2 * last)
    turned = 2 * values[-1] - values[np.minimum(2 * last - place, last)]
    found = np.where(place <= last, values[np.minimum(place, last)], turned)
    return np.where(turns % 2 == 0, found, 2 * values[-1] - found)


def of_velocity(values: np.ndarray, room: int) -> np.ndarray:
    return np.pad(values, room, "reflect", reflect_type="odd")


def butterworth(values, dt, low, high, order, zero_phase, beyond: Callable = at_rest) -> np.ndarray:
    edges = [edge for edge in (low, high) if edge is not None]
    kind = "bandpass" if len(edges) == 2 else "lowpass" if low is None else "highpass"
    sections = scipy.signal.butter(order, edges if len(edges) == 2 else edges[0], kind, fs=1 / dt, output="sos")
    if not zero_phase:
        return scipy.signal.sosfilt(sections, values)
    room = int(min(max(ROOM * values.size, 100_000), np.ceil(3 * order / (min(edges) * dt))))
    return scipy.signal.sosfiltfilt(sections, beyond(values, room), padtype=None)[room : room + values.size]
