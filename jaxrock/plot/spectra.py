"""Figures of rocking spectra: of one motion, of a suite, of a family of pulses."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxrock.plot.style import (
    BLUE,
    DURATION,
    GREY,
    RATIO,
    RED,
    broken_curve,
    cell_edges,
    figure,
    in_order,
    shade,
    without_more,
)
from jaxrock.studies.spectrum import Spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BAND = (16.0, 50.0, 84.0)  # percentiles of a suite that are drawn
_RATIOS = ("rotation_ratio", "velocity_ratio")


@figure(2)
def spectrum(result: Spectrum, axes: "Sequence[Axes] | None" = None, *, by_duration: bool = False) -> "Sequence[Axes]":
    """Draw a rocking spectrum: peak rotation and peak velocity; sizes that overturn are shaded.

    A response that was not computed (see `status`) is a gap, with a cross on the lower axis.

    Of a suite it draws single motions thin, with gaps where they overturn, and over them the median and the band from
    the 16th to the 84th percentile (`Spectrum.percentiles`). The band reaches the top where the 84th percentile
    overturns. Sizes of which the median overturns are shaded. Where scenes without a verdict leave a percentile open,
    the range between its bounds is hatched.

    **Arguments:**

    - `result`: from `rocking_spectrum` or `self_similar_spectrum`, without further axes.
    - `axes`: two matplotlib axes; None makes a figure.
    - `by_duration`: whether to draw a self-similar spectrum over the pulse duration, one curve per uplift strength.

    **Returns:** the two axes.

    **Raises:** ValueError for a spectrum with further axes, or `by_duration` of one of a record.
    """
    import matplotlib.pyplot as plt

    without_more(result)
    if by_duration and result.intensity is None:
        raise ValueError("Argument `by_duration` must be False for the spectrum of a motion that is given in seconds.")

    own = axes is None
    if axes is None:
        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5.5), layout="constrained")
    across = RATIO if result.intensity is not None else r"$2\pi/p$ [s]"
    if result.motions is None:
        _draw_rows(axes, result, by_duration, own)
    else:
        _draw_suite(axes, result)
    axes[0].set_ylabel(r"peak rotation $\theta_{max}/\alpha$")
    axes[1].set_ylabel(r"peak velocity $\dot\theta_{max}/(p\alpha)$")
    axes[1].set_xlabel(DURATION if by_duration else across)
    return axes


def _draw_rows(axes: "Sequence[Axes]", result: Spectrum, by_duration: bool, own: bool) -> None:
    """Draw a curve for every row of a spectrum, and shade sizes that overturn in all rows."""
    abscissa, order = in_order(result.pulse_duration if by_duration else result.abscissa)
    labels = result.uplift_strength if by_duration else result.intensity
    known = np.atleast_2d(~np.asarray(result.is_open))[:, order]
    lost = np.atleast_2d(np.asarray(result.overturned))[:, order] & known
    for axis, name in zip(axes, _RATIOS):
        values = np.where(known, np.atleast_2d(np.asarray(getattr(result, name)))[:, order], np.nan)
        _curves(axis, abscissa, values, labels)
        said = "overturned" if len(values) == 1 else "all overturned"
        shade(axis, abscissa, lost.all(axis=0), color=RED, alpha=0.15, linewidth=0, label=said)
        if axis.dataLim.y1 <= 0:  # all overturned, or all at rest
            axis.set_ylim(0, 1, auto=True)
    if known.any() and not lost.any() and all(axis.dataLim.y1 <= 0 for axis in axes):
        _say_at_rest(axes[0])
    self_similar = result.intensity is not None
    if self_similar or axes[0].get_legend_handles_labels()[0]:
        many = own and len(lost) > 4  # a long legend would hide the curves: place it outside
        axes[0].legend(
            title=("uplift strength" if by_duration else "intensity") if self_similar else None,
            fontsize=8, title_fontsize=8, framealpha=0.85, edgecolor="none",
            loc="upper left" if many else "upper right", bbox_to_anchor=(1.0, 1.0),
        )  # fmt: skip


def _say_at_rest(axis: "Axes") -> None:
    axis.text(0.5, 0.5, "no block uplifts", ha="center", color=GREY, transform=axis.transAxes)


def _curves(axis: "Axes", abscissa: np.ndarray, rows: np.ndarray, labels) -> None:
    """Draw the curves of a spectrum; NaN was not computed, and gets a cross on the lower axis."""
    import matplotlib.pyplot as plt

    colors = plt.colormaps["viridis"](np.linspace(0, 0.85, len(rows))) if len(rows) > 1 else [BLUE]
    for i, (curve, color) in enumerate(zip(rows, colors)):
        label = None if labels is None else f"{float(labels[i]):g}"
        broken_curve(axis, abscissa, curve, color=color, linewidth=1, label=label)
    _start_at_zero(axis, abscissa)
    said: str | None = "not computed"
    for row, color in zip(np.isnan(rows), colors):
        if row.any():
            level = np.full(row.sum(), 0.02)
            axis.plot(abscissa[row], level, "x", color=color, markersize=4, label=said,
                      transform=axis.get_xaxis_transform())  # fmt: skip
            said = None


def _start_at_zero(axis: "Axes", abscissa: np.ndarray) -> None:
    """Let the vertical axis start at zero, unless the user makes it logarithmic."""
    axis.update_datalim([(abscissa[0], 0)])
    axis.lines[-1].sticky_edges.y.append(0)
    axis.autoscale_view()


def _draw_suite(axes: "Sequence[Axes]", result: Spectrum) -> None:
    """Draw single motions, the band of percentiles and the median of a suite's spectrum."""
    abscissa, order = in_order(result.abscissa)
    known = ~np.asarray(result.is_open)[:, order]
    for axis, name in zip(axes, _RATIOS):
        rows = np.asarray(getattr(result, name))[:, order]
        _thin_curves(axis, abscissa, np.where(known & np.isfinite(rows), rows, np.nan), len(rows))
        lower, upper = (np.asarray(bound)[:, order] for bound in result.percentiles(_BAND, name))
        median = np.where(lower[1] == upper[1], lower[1], np.nan)
        broken_curve(axis, abscissa, median, color=BLUE, linewidth=1.8, label="median")
        _start_at_zero(axis, abscissa)
        top = axis.dataLim.y1 * 1.05 if axis.dataLim.y1 > 0 else 1.0  # stands for infinity
        lower, upper = np.minimum(lower, top), np.minimum(upper, top)
        axis.fill_between(abscissa, lower[0], upper[2], color=BLUE, alpha=0.2, linewidth=0, label="16 to 84 %")
        _hatch_open(axis, abscissa, lower, upper)
        falls = np.isinf(median)
        shade(axis, abscissa, falls, color=RED, alpha=0.15, linewidth=0, label="half of the motions overturn")
        axis.set_ylim(0, top, auto=True)
    if known.any() and not np.asarray(result.overturned).any() and not (np.asarray(result.rotation_ratio) > 0).any():
        _say_at_rest(axes[0])
    axes[0].legend(fontsize=8, framealpha=0.85, edgecolor="none", loc="upper right")


def _thin_curves(axis: "Axes", abscissa: np.ndarray, rows: np.ndarray, count: int) -> None:
    """Draw all rows as one line, with breaks between them."""
    across = np.tile(np.append(abscissa, np.nan), len(rows))
    up = np.column_stack([rows, np.full(len(rows), np.nan)]).ravel()
    said = f"{count} motion{'s' if count > 1 else ''}"
    broken_curve(axis, across, up, color=GREY, linewidth=0.5, alpha=0.6, label=said)


def _hatch_open(axis: "Axes", abscissa: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Hatch the ranges between the bounds of percentiles, each as wide as the cell of its size."""
    edges, said = cell_edges(abscissa), "open"  # type: tuple[np.ndarray, str | None]
    for low, high in zip(lower, upper):
        (places,) = np.nonzero(high > low)
        if places.size:
            axis.bar(edges[places], (high - low)[places], np.diff(edges)[places], low[places], align="edge",
                     facecolor="none", edgecolor=GREY, linewidth=0, hatch="////", label=said)  # fmt: skip
            said = None
