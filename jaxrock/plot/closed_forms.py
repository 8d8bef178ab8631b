"""Figures of closed forms: safety regions under single lobes and one cycle of a sine."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from jaxrock.closed_form import sine_pulse, single_lobe
from jaxrock.plot.style import DURATION, GREY, INTENSITY, RATIO, RED, STRENGTH, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@figure(1)
def safety_regions(
    shape: float, axis: "Axes | None" = None, *, longest: float = 8.0, points: int = 400, legend: bool = True
) -> "Axes":
    """Draw the outcomes of a slender block under a single-lobe pulse of one shape, from closed forms.

    **Arguments:**

    - `shape`: of the pulse, from -inf (rectangle) to +inf (spike).
    - `axis`: matplotlib axis; None makes a figure.
    - `longest`: largest pulse duration p t_d. `points`: along each curve. `legend`: whether to explain the letters
      below the axis.

    **Returns:** the axis.

    **Source:** Voyagaki, Psycharis & Mylonakis (2012), figures 3.1 to 3.3.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5, 4), layout="constrained")
    duration = np.linspace(longest / points, longest, points)
    curves = [
        np.asarray(curve(duration, shape))
        for curve in (single_lobe.rising_wall, single_lobe.falling_wall, single_lobe.safety_wall)
    ]
    border = np.maximum(np.asarray(single_lobe.peak_border(duration, shape)), curves[2])
    edges = [0 * duration, *curves, border, 1 + 0 * duration]
    colors = ("#8e1f18", RED, "#e08a80", "#cfe0ea", "#f3efe6")
    names = ("$O_1$: past α as the pulse rises", "$O_2$: as it falls", "$O_3$: after it",
             "$S_2$: safe, peak after the pulse", "$S_1$: safe, peak while it falls")  # fmt: skip
    for lower, upper, color, name in zip(edges, edges[1:], colors, names):
        axis.fill_between(duration, lower, upper, color=color, linewidth=0, label=name)
        if (room := upper - lower).max() > 0.08:
            widest = np.argmax(np.where((duration > 0.06 * longest) & (duration < 0.94 * longest), room, -1))
            middle = (lower[widest] + upper[widest]) / 2
            letters = {"ha": "center", "va": "center", "color": "white" if name.startswith("$O") else "black"}
            axis.text(duration[widest], middle, name[:5], **letters)
    axis.plot(duration, curves[2], color="black", linewidth=1.2)
    axis.set(xlim=(0, longest), ylim=(0, 1), xlabel=DURATION, ylabel=f"{STRENGTH} $g\\alpha/A_g$")
    if legend:
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=7, frameon=False)
    return axis


@figure(1)
def sine_regions(
    restitution: float,
    axis: "Axes | None" = None,
    *,
    frequency_ratio: ArrayLike | None = None,
    by_duration: bool = False,
) -> "Axes":
    """Draw the closed-form curves of overturning under one cycle of a sine over an axis or a map.

    **Arguments:**

    - `restitution`: in [0, 1].
    - `axis`: matplotlib axis, such as `overturning` returns; None makes a figure.
    - `frequency_ratio`: (n,) omega/p; None: 0.3 to 8.
    - `by_duration`: whether to draw uplift strength over pulse duration, in place of intensity over frequency ratio;
      it must agree with the map.

    **Returns:** the axis.

    **Raises:** ValueError for an axis over pulse durations without `by_duration`, for one over frequency ratios with
    it, and for one on which `borders` are drawn by strength, or by a `scale`.

    **Source:** Dimitrakopoulos & DeJong (2012), figure 4: equations 3.10, 3.18, 3.20 with 3.21, and 3.31.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5, 4), layout="constrained")
    else:
        _check_coordinates(axis, by_duration)
    ratio = np.linspace(0.3, 8, 300) if frequency_ratio is None else np.asarray(frequency_ratio, float)

    def after(k):
        return lambda ratio: np.asarray(sine_pulse.after_pulse_limits(ratio, restitution)[k])

    def lower(ratio):
        edge = after(0)(ratio)
        return np.where(edge > np.asarray(sine_pulse.impact_time_limit(ratio)), edge, np.inf)

    curves = {
        "case 2: no impact": (sine_pulse.no_impact_limit, "black", "-"),
        "case 1.2: impact after the pulse": (after(1), "#0d2f4a", "-"),
        None: (lower, "#0d2f4a", "-"),
        "case 1.1: impact during the pulse": (lambda x: sine_pulse.during_pulse_limit(x, restitution), "#7a1a14", "-"),
        "first impact as the pulse ends": (sine_pulse.impact_time_limit, GREY, "--"),
    }
    for name, (curve, color, style) in curves.items():
        x, y = _to_its_tips(curve, ratio)
        x, y = (2 * np.pi / x, 1 / y) if by_duration else (x, y)
        axis.plot(x, y, color=color, linestyle=style, linewidth=1.2, label=name)
    words = (DURATION, f"{STRENGTH} $g\\alpha/a_g$") if by_duration else (RATIO, f"{INTENSITY} $a_g/g\\alpha$")
    axis.set_xlabel(axis.get_xlabel() or words[0])  # keep the labels of a map on the axis
    axis.set_ylabel(axis.get_ylabel() or words[1])
    before = axis.get_legend()
    axis.legend(loc="upper left" if before is None or by_duration else "lower right", fontsize=7)
    if before is not None:
        axis.add_artist(before)  # keep the legend of a map on the axis
    return axis


def _check_coordinates(axis: "Axes", by_duration: bool) -> None:
    """Raise ValueError for an axis whose labels name other quantities, or multiples of the expected ones."""
    across, upward = axis.get_xlabel(), axis.get_ylabel()
    if across == (RATIO if by_duration else DURATION):
        raise ValueError(f"Argument `by_duration` must be {not by_duration} for an axis over {across!r}.")
    mine, other = (STRENGTH, INTENSITY) if by_duration else (INTENSITY, STRENGTH)
    if upward.startswith((other, f"{mine} times ")):
        raise ValueError(f"Argument `axis` must have the {mine} upward, but has {upward!r}.")


_PIECE = 8  # points of a curve in one call


def _to_its_tips(curve: Callable, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve with further points up to its ends, which bisection finds between finite and other values."""

    def at(places: np.ndarray) -> np.ndarray:
        # Pieces of one size need a single compiled program; there are few points, because a curve has few ends.
        whole = np.resize(places, (-(-places.size // _PIECE), _PIECE))
        return np.concatenate([np.asarray(curve(piece)) for piece in whole])[: places.size]

    y = np.asarray(curve(x))
    known = np.isfinite(y)
    ends = np.flatnonzero(known[1:] != known[:-1])
    inner = start = np.where(known[ends], x[ends], x[ends + 1])
    outer = np.where(known[ends], x[ends + 1], x[ends])
    for _ in range(45 if ends.size else 0):
        middle = (inner + outer) / 2
        there = np.isfinite(at(middle))
        inner, outer = np.where(there, middle, inner), np.where(there, outer, middle)
    if ends.size:
        share = 1 - np.linspace(1, 0, 20)[1:, None] ** 3  # curves turn at their ends: points are denser there
        more = (start + share * (inner - start)).ravel()
        x, y = np.concatenate([x, more]), np.concatenate([y, at(more)])
    order = np.argsort(x)
    return x[order], np.where(np.isfinite(y), y, np.nan)[order]
