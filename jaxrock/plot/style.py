"""Colours that all figures share, and ticks of logarithmic axes."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, RED, GREY, SAND = "#1f5a8a", "#b3352c", "#8a8a8a", "#d9a441"


def log_ticks(axis: "Axes") -> "Axes":
    """Label the logarithmic axes of a figure at 1, 2, 5, 10, ..., in plain numbers, and nowhere else.

    **Arguments:**

    - `axis`: matplotlib axis; what is not logarithmic in it is left alone.

    **Returns:** the axis.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for scale, ticks in ((axis.get_xscale(), axis.xaxis), (axis.get_yscale(), axis.yaxis)):
        if scale == "log":
            ticks.set_major_locator(LogLocator(subs=(1, 2, 5)))
            ticks.set_major_formatter(StrMethodFormatter("{x:g}"))
            ticks.set_minor_formatter(NullFormatter())
    return axis
