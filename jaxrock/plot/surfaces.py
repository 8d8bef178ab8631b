"""Figures of many responses: spectra and overturning maps."""

import numpy as np

from jaxrock.plot.style import BLUE, GREY, RED
from jaxrock.studies.spectra import OverturningMap, Spectrum

_DURATION = "pulse duration $p\\,t_d$"


def spectrum(result: Spectrum, axes=None, *, by_duration: bool = False):
    """Draw a rocking spectrum: peak rotation and peak velocity; overturned blocks at the top edge.

    **Arguments:**

    - `result`: from `rocking_spectrum` or `self_similar_spectrum`, without further axes.
    - `axes`: two matplotlib axes; None makes a figure.
    - `by_duration`: of a self-similar spectrum: over the pulse duration, one curve per uplift strength.

    **Returns:** the two axes.

    **Raises:** ValueError for a spectrum with further axes, or `by_duration` of one of a record.
    """
    import matplotlib.pyplot as plt

    _without_more(result)
    if by_duration and result.intensity is None:
        raise ValueError("Argument `by_duration` must be False for the spectrum of a motion that is given in seconds.")

    if axes is None:
        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5.5), layout="constrained")
    abscissa = np.asarray(result.pulse_duration if by_duration else result.abscissa)
    labels = result.uplift_strength if by_duration else result.intensity
    rows = np.atleast_2d(np.asarray(result.overturned))
    for axis, values in zip(axes, (result.max_rotation, result.max_velocity)):
        values = np.atleast_2d(np.where(np.isfinite(values), values, np.nan))
        colors = plt.colormaps["viridis"](np.linspace(0, 0.85, len(values))) if len(values) > 1 else [BLUE]
        for i, (curve, color) in enumerate(zip(values, colors)):
            label = None if labels is None else f"{float(labels[i]):g}"
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
    across = _DURATION if by_duration else r"frequency ratio $\omega/p$"
    axes[1].set_xlabel(across if self_similar else r"$2\pi/p$ [s]")
    if self_similar or axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(
            title=("uplift strength" if by_duration else "intensity") if self_similar else None,
            fontsize=8, title_fontsize=8, frameon=False, loc="upper right",
        )  # fmt: skip
    return axes


def overturning(result: OverturningMap, axis=None, *, by_duration: bool = False):
    """Draw an overturning map: safe, overturned without impact, overturned after impacts.

    **Arguments:**

    - `result`: from `overturning_map`, without further axes.
    - `axis`: matplotlib axis; None makes a figure.
    - `by_duration`: uplift strength over pulse duration, as single-lobe pulses are drawn, in place of intensity over
      frequency ratio.

    **Returns:** the axis.

    **Raises:** ValueError for a map with further axes.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    _without_more(result)

    if axis is None:
        _, axis = plt.subplots(figsize=(7, 5), layout="constrained")
    names = ("not computed", "safe", "overturned without impact", "overturned after impacts")
    colors = ("black", "#f3efe6", BLUE, RED)
    axis.pcolormesh(
        np.asarray(result.pulse_duration if by_duration else result.frequency_ratio),
        np.asarray(result.uplift_strength if by_duration else result.intensity),
        np.asarray(result.state),
        cmap=ListedColormap(colors),
        norm=BoundaryNorm((-1.5, -0.5, 0.5, 1.5, 2.5), 4),
        shading="nearest",
        rasterized=True,
    )
    shown = sorted(set(np.unique(np.asarray(result.state)).tolist()) | {0, 1, 2})
    handles = [Patch(facecolor=colors[i + 1], edgecolor=GREY, label=names[i + 1]) for i in shown]
    axis.legend(handles=handles, loc="upper left", fontsize=8)
    axis.set_xlabel(_DURATION if by_duration else r"frequency ratio $\omega/p$")
    axis.set_ylabel(
        "uplift strength (uplift threshold / peak acceleration)"
        if by_duration
        else "intensity (peak acceleration / uplift threshold)"
    )
    return axis


def _without_more(result: Spectrum | OverturningMap) -> None:
    if result.parameters:
        names = ", ".join(f"`{name}`" for name in result.parameters)
        raise ValueError(f"Argument `result` must have no further axes, but has {names}: draw one of its parts.")
