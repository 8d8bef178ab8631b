"""Figures of sensitivities and of critical amplitudes."""

from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike

from jaxrock._arguments.annotations import pair
from jaxrock._arguments.ranges import one_of, positive, scalar
from jaxrock.plot.style import BLUE, DURATION, RED, SAND, draw_cells, figure, in_order
from jaxrock.studies.critical_ends import Critical, intervals_of
from jaxrock.studies.sensitivities import Sensitivity, SensitivityMap, SlopeStatus

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RESULTS = ("max_rotation", "max_velocity", "margin")


@figure(1)
def tornado(sensitivity: Sensitivity, result: str = "max_rotation", axis: "Axes | None" = None) -> "Axes":
    """Draw the elasticities of one result as bars, the largest on top.

    **Arguments:**

    - `sensitivity`: result of `sensitivity`, of one scene.
    - `result`: "max_rotation", "max_velocity" or "margin".
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.

    **Raises:** ValueError for many scenes, and for a result without elasticities, such as the peaks of a block that
    overturns.
    """
    import matplotlib.pyplot as plt

    one_of("result", result, _RESULTS)
    slopes = getattr(sensitivity, result)
    elasticity = np.asarray(slopes.elasticity)
    if elasticity.ndim != 1:
        many = elasticity.shape[:-1]
        raise ValueError(f"Argument `sensitivity` must be of one scene, but is of many, of shape {many}: draw one.")
    if np.isnan(elasticity).all():
        lost = result != "margin" and bool(sensitivity.outcome.overturned)
        instead = "the block overturns: draw its `margin`" if lost else SlopeStatus[slopes.status]
        raise ValueError(f"Argument `sensitivity` must have elasticities of {result!r}, but has none: {instead}")
    if axis is None:
        _, axis = plt.subplots(figsize=(5, 3), layout="constrained")
    order = np.argsort(np.abs(elasticity))
    names = [sensitivity.names[k].replace("_", " ") for k in order]
    axis.barh(names, elasticity[order], color=[BLUE if x > 0 else RED for x in elasticity[order]], height=0.6)
    axis.axvline(0, color="black", linewidth=0.8)
    axis.set_xlabel(f"{result.replace('_', ' ')}: per cent for one per cent")
    return axis


@figure(1)
def sensitivity_map(
    surface: SensitivityMap,
    parameter: str,
    result: str = "max_rotation",
    axis: "Axes | None" = None,
    *,
    limit: float | None = None,
) -> "Axes":
    """Draw the elasticity of one result by one parameter over pulse duration and uplift strength.

    Points of the map where blocks overturn, or where the response is not smooth, are left grey.

    **Arguments:**

    - `surface`: result of `sensitivity_map`.
    - `parameter`: one of its names, such as "shape" or "uplift_strength".
    - `result`: "max_rotation", "max_velocity" or "margin".
    - `axis`: matplotlib axis; None makes a figure. `limit`: end of the colour scale; None: the 98th percentile.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    one_of("result", result, _RESULTS)
    one_of("parameter", parameter, surface.sensitivity.names)
    if axis is None:
        _, axis = plt.subplots(figsize=(5, 4), layout="constrained")
    sensitivity = surface.sensitivity
    values = np.asarray(getattr(sensitivity, result).elasticity)[..., sensitivity.names.index(parameter)]
    known = np.isfinite(values)
    if limit is None:
        limit = max(float(np.percentile(np.abs(values[known]), 98)), 1e-12) if known.any() else 1.0
    axis.set_facecolor("#d5d5d5")
    x, y = np.asarray(surface.pulse_duration), np.asarray(surface.uplift_strength)
    (x, columns), (y, rows) = in_order(x), in_order(y)
    values = values[np.ix_(rows, columns)]
    picture = draw_cells(axis, x, y, values, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axis.figure.colorbar(picture, ax=axis, label="elasticity")
    axis.set_title(f"{result.replace('_', ' ')} by {parameter.replace('_', ' ')}")
    axis.set(xlabel=DURATION, ylabel="uplift strength (threshold/amplitude)")
    return axis


@figure(1)
def critical(
    abscissa: ArrayLike, ends: Critical, axis: "Axes | None" = None, *, label: str = "what the scenes differ by"
) -> "Axes":
    """Draw all intensities at which blocks begin or cease to overturn, for many scenes side by side.

    Scenes that were not computed at all intensities (`Critical.complete`) have a cross on the lower axis.

    **Arguments:**

    - `abscissa`: (scenes,) the quantity by which the scenes differ, such as periods [s].
    - `ends`: result of `critical_amplitudes` for many scenes.
    - `axis`: matplotlib axis; None makes a figure.
    - `label`: of the axis across, such as "period [s]".

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if ends.intensity.ndim != 2 or np.shape(abscissa) != ends.intensity.shape[:1]:
        raise ValueError(
            f"Arguments `abscissa` and `ends` must be of as many scenes, along one axis, but have shapes "
            f"{np.shape(abscissa)} and {ends.intensity.shape[:-1]}."
        )
    if axis is None:
        _, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    x = np.broadcast_to(np.asarray(abscissa)[:, None], ends.intensity.shape)
    there = np.isfinite(np.asarray(ends.intensity))
    rising, impacts = np.asarray(ends.rising), np.asarray(ends.impacts)
    kinds = (
        ("overturns above: without impact", BLUE, rising & (impacts == 0)),
        ("overturns above: after impacts", RED, rising & (impacts > 0)),
        ("safe again above", SAND, ~rising),
    )
    for name, color, kind in kinds:
        axis.plot(x[there & kind], np.asarray(ends.intensity)[there & kind], ".", color=color, markersize=3, label=name)
    part = np.asarray(abscissa)[~np.asarray(ends.complete)]
    if part.size:
        level = np.full(part.size, 0.02)
        axis.plot(part, level, "kx", markersize=4, label="not all computed", transform=axis.get_xaxis_transform())
    axis.set(xlabel=label, ylabel="intensity: amplitude/threshold")
    axis.legend(fontsize=8, frameon=False)
    return axis


@figure(1)
def critical_scales(
    ends: Critical,
    axis: "Axes | None" = None,
    *,
    between: Annotated[tuple[float, float] | None, pair] = None,
) -> "Axes":
    """Draw the scales at which one block overturns as bands, and at their ends the number of impacts before.

    Intervals too thin to be seen as bands are seen as lines.

    **Arguments:**

    - `ends`: result of `critical_amplitudes`, or `critical_durations`, for one scene.
    - `axis`: matplotlib axis; None makes a figure.
    - `between`: least and largest scale that were searched [-], positive and rising; None: a little beyond the ends.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if ends.value.ndim != 1 or ends.scale is None:
        raise ValueError("Argument `ends` must be of one scene and have scales, as `critical_amplitudes` returns it.")
    scale, rising = (np.asarray(x)[: int(ends.count)] for x in (ends.scale, ends.rising))
    limits = between if between is not None else _around(scale)
    low, high = (float(scalar("between", positive("between", end))) for end in limits)
    if low >= high:
        raise ValueError(f"Argument `between` must be rising, but is {between}.")
    if axis is None:
        _, axis = plt.subplots(figsize=(7, 3), layout="constrained")
    for first, last in intervals_of(ends):
        edges = low if first is None else scale[first], high if last is None else scale[last]
        axis.axvspan(*edges, facecolor=RED, edgecolor=RED, linewidth=0.5, alpha=0.25)
    impacts = np.asarray(ends.impacts)[: scale.size]
    for name, color, kind in (("overturns above", RED, rising), ("stands above", BLUE, ~rising)):
        axis.plot(scale[kind], impacts[kind], ".", color=color, label=name)
    axis.set(xlabel="scale", ylabel="impacts before", xlim=(low, high))
    axis.set_ylim(bottom=min(0, axis.get_ylim()[0]))
    axis.legend(fontsize=8, frameon=False)
    return axis


def _around(scale: np.ndarray) -> tuple[float, float]:
    """Return limits a twentieth beyond the ends; of no ends, around 1."""
    return (scale.min() / 1.05, scale.max() * 1.05) if scale.size else (0.5, 2.0)
