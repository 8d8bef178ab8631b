"""Figures of many responses: spectra and overturning maps."""

import numpy as np

from jaxrock.plot.style import BLUE, GREY, RED
from jaxrock.studies.spectra import OverturningMap, Spectrum


def spectrum(result: Spectrum, axes=None):
    """Draw a rocking spectrum: peak rotation and peak velocity; overturned blocks at the top edge.

    **Arguments:**

    - `result`: from `rocking_spectrum` or `self_similar_spectrum`.
    - `axes`: two matplotlib axes; None makes a figure.

    **Returns:** the two axes.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5.5), layout="constrained")
    abscissa = np.asarray(result.abscissa)
    rows = np.atleast_2d(np.asarray(result.overturned))
    for axis, values in zip(axes, (result.max_rotation, result.max_velocity)):
        values = np.atleast_2d(np.where(np.isfinite(values), values, np.nan))
        colors = plt.colormaps["viridis"](np.linspace(0, 0.85, len(values))) if len(values) > 1 else [BLUE]
        for i, (curve, color) in enumerate(zip(values, colors)):
            label = None if result.intensity is None else f"{float(result.intensity[i]):g}"
            axis.plot(abscissa, curve, color=color, linewidth=1, label=label)
        axis.set_ylim(bottom=0)
        lost = rows.any(axis=0)
        if lost.any():
            where = lost if len(values) == 1 else rows.all(axis=0)
            axis.fill_between(
                abscissa, 0, 1, where=where, transform=axis.get_xaxis_transform(), color=RED, alpha=0.15,
                linewidth=0, label="overturned" if len(values) == 1 else "all overturned", step="mid",
            )  # fmt: skip
    axes[0].set_ylabel(r"peak rotation $\theta_{max}/\alpha$")
    axes[1].set_ylabel(r"peak velocity $\dot\theta_{max}/(p\alpha)$")
    self_similar = result.intensity is not None
    axes[1].set_xlabel(r"frequency ratio $\omega/p$" if self_similar else r"$2\pi/p$ [s]")
    if self_similar or axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(
            title="intensity" if self_similar else None, fontsize=8, title_fontsize=8, frameon=False, loc="upper right"
        )
    return axes


def overturning(result: OverturningMap, axis=None):
    """Draw an overturning map: safe, overturned without impact, overturned after impacts.

    **Arguments:**

    - `result`: from `overturning_map`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    if axis is None:
        _, axis = plt.subplots(figsize=(7, 5), layout="constrained")
    names = ("not computed", "safe", "overturned without impact", "overturned after impacts")
    colors = ("black", "#f3efe6", BLUE, RED)
    axis.pcolormesh(
        np.asarray(result.frequency_ratio),
        np.asarray(result.intensity),
        np.asarray(result.state),
        cmap=ListedColormap(colors),
        norm=BoundaryNorm((-1.5, -0.5, 0.5, 1.5, 2.5), 4),
        shading="nearest",
        rasterized=True,
    )
    shown = sorted(set(np.unique(np.asarray(result.state)).tolist()) | {0, 1, 2})
    handles = [Patch(facecolor=colors[i + 1], edgecolor=GREY, label=names[i + 1]) for i in shown]
    axis.legend(handles=handles, loc="upper left", fontsize=8)
    axis.set_xlabel(r"frequency ratio $\omega/p$")
    axis.set_ylabel("intensity (peak acceleration / uplift threshold)")
    return axis
