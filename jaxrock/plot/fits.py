"""Figures of fits to measured histories."""

from jaxrock.inverse.history_fit import HistoryFit
from jaxrock.plot.style import BLUE, GREY, RED


def history_fit(fit: HistoryFit, time, axes=None):
    """Draw a measured and a fitted history, and what is left between them.

    **Arguments:**

    - `fit`: result of `fit_history`; `time`: (n,) of the measurements [s].
    - `axes`: two matplotlib axes; None makes a figure.

    **Returns:** the axes.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4), layout="constrained", height_ratios=(2, 1))
    alpha = float(fit.block.alpha)
    axes[0].plot(time, (fit.rotation + fit.residuals) / alpha, ".", color=GREY, markersize=3, label="measured")
    axes[0].plot(time, fit.rotation / alpha, color=BLUE, linewidth=1, label="fitted")
    axes[1].plot(time, fit.residuals / alpha, ".", color=RED, markersize=3)
    axes[1].axhline(0, color=GREY, linewidth=0.5)
    axes[0].set_ylabel(r"rotation $\theta/\alpha$")
    axes[1].set(xlabel="time [s]", ylabel="residual")
    axes[0].legend(fontsize=8, frameon=False, loc="upper right")
    return axes
