"""Figures of fits to measured histories, and of records found by `find_record`."""

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from jaxrock.blocks.rigid import Block
from jaxrock.inverse.found_record import FoundRecord
from jaxrock.inverse.history_fit import HistoryFit
from jaxrock.plot.style import BLUE, GREY, RED, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@figure(2)
def history_fit(fit: HistoryFit, time: ArrayLike, axes: "Sequence[Axes] | None" = None) -> "Sequence[Axes]":
    """Draw a measured and a fitted history, and their residuals.

    **Arguments:**

    - `fit`: result of `fit_history`; `time`: (n,) times of the measurements, increasing [s].
    - `axes`: two matplotlib axes; None makes a figure.

    **Returns:** the axes.

    **Raises:** ValueError for times whose number is not that of the measurements, or that do not increase.
    """
    import matplotlib.pyplot as plt

    time, count = np.asarray(time), fit.residuals.size
    if time.shape != (count,):
        raise ValueError(f"Argument `time` must be of the {count} measurements, but has the shape {time.shape}.")
    if not (np.diff(time) > 0).all():
        raise ValueError("Argument `time` must increase, as the measurements do, but does not.")
    if axes is None:
        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4), layout="constrained", height_ratios=(2, 1))
    alpha = float(fit.block.alpha if isinstance(fit.block, Block) else min(fit.block.alpha1, fit.block.alpha2))
    axes[0].plot(time, (fit.rotation + fit.residuals) / alpha, ".", color=GREY, markersize=3, label="measured")
    axes[0].plot(time, fit.rotation / alpha, color=BLUE, linewidth=1, label="fitted")
    axes[1].plot(time, fit.residuals / alpha, ".", color=RED, markersize=3)
    axes[1].axhline(0, color=GREY, linewidth=0.5)
    axes[0].set_ylabel(r"rotation $\theta/\alpha$")
    axes[1].set(xlabel="time [s]", ylabel=r"residual $\theta/\alpha$")
    axes[0].legend(fontsize=8, frameon=False, loc="upper right")
    return axes


@figure(3)
def found_record(found: FoundRecord, axes: "Sequence[Axes] | None" = None) -> "Sequence[Axes]":
    """Draw a found record, the record that was changed, and the change, over time and frequency.

    **Arguments:**

    - `found`: result of `find_record`.
    - `axes`: three matplotlib axes; None makes a figure.

    **Returns:** the axes.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(3, 1, figsize=(7, 6), layout="constrained", height_ratios=(2, 1, 1))
    before, after, dt = np.asarray(found.start.samples), np.asarray(found.record.samples), float(found.start.dt)
    time, change = dt * np.arange(before.size), after - before
    axes[0].plot(time, before, color=GREY, linewidth=0.8, label="before")
    axes[0].plot(time, after, color=BLUE, linewidth=0.5, label="found")
    axes[1].plot(time, change, color=RED, linewidth=0.5)
    frequency = np.fft.rfftfreq(before.size, dt)[1:]
    for samples, color in ((before, GREY), (change, RED)):
        axes[2].loglog(frequency, dt * np.abs(np.fft.rfft(samples))[1:], color=color, linewidth=0.5)
    axes[0].set_title(textwrap.fill(found.start.name or "", 95), fontsize=8)
    large = time[np.abs(change) > 0.02 * np.abs(change).max()]
    if large.size:  # show only the time of the change
        around = 0.5 * (large[-1] - large[0]) + 10 * dt
        axes[0].set_xlim(max(large[0] - around, 0.0), min(large[-1] + around, time[-1]))
        axes[1].set_xlim(axes[0].get_xlim())
    axes[0].set(xlabel="time [s]", ylabel="acceleration [g]")
    axes[1].set(xlabel="time [s]", ylabel="change [g]")
    axes[2].set(xlabel="frequency [Hz]", ylabel="spectrum [g s]")
    axes[0].legend(fontsize=8, frameon=False, loc="upper right")
    return axes
