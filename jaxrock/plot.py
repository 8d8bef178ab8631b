"""Figures: functions that take results, draw them into matplotlib axes and return the axes."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.closed_form import sine_pulse, single_lobe
from jaxrock.critical import Critical
from jaxrock.fragility import LogNormalFragility
from jaxrock.histories import HistoryFit
from jaxrock.response import Response
from jaxrock.sensitivity import Sensitivity, SensitivityMap
from jaxrock.spectra import OverturningMap, Spectrum
from jaxrock.suites import SimulatedFragility
from jaxrock.surfaces import SimulatedSurface, SurfaceFragility

_BLUE, _RED, _GREY, _SAND = "#1f5a8a", "#b3352c", "#8a8a8a", "#d9a441"


def _dense(response: Response) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], rotation over alpha and velocity over p alpha, finely enough for the corners at impacts."""
    scene = response.stepper.scene
    time = np.linspace(0, float(response.duration), 20001)
    rotation, velocity = response(time)
    alpha, p = float(scene.alpha), float(scene.p)
    return time, np.asarray(rotation) / alpha, np.asarray(velocity) / (p * alpha)


def history(response: Response, axes=None):
    """Draw rotation over alpha, velocity over p alpha and ground acceleration against time, impacts marked.

    **Arguments:**

    - `response`: result of `simulate`.
    - `axes`: three matplotlib axes; None makes a figure.

    **Returns:** the three axes.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 6), layout="constrained")
    scene = response.stepper.scene
    time, rotation, velocity = _dense(response)
    acceleration = np.asarray(scene.motion.acceleration(time))
    impacts = np.asarray(response.impact_times)
    speeds = np.asarray(response.impact_velocities) / (float(scene.p) * float(scene.alpha))
    for axis, curve in zip(axes, (rotation, velocity, acceleration)):
        axis.plot(time, curve, color=_BLUE if axis is not axes[2] else "black", linewidth=0.9)
        axis.axhline(0, color=_GREY, linewidth=0.5)
    axes[0].plot(impacts, np.zeros_like(impacts), "|", color=_RED, markersize=7, label="impact")
    axes[1].plot(impacts, speeds, ".", color=_RED, markersize=3)
    threshold = float(scene.table.threshold)
    for sign in (-1, 1):
        axes[2].axhline(sign * threshold, color=_SAND, linewidth=0.9, label="uplift threshold" if sign > 0 else None)
    axes[0].set_ylabel(r"rotation $\theta/\alpha$")
    axes[1].set_ylabel(r"velocity $\dot\theta/(p\alpha)$")
    axes[2].set_ylabel("ground\nacceleration [g]")
    axes[2].set_xlabel("time [s]")
    for axis in (axes[0], axes[2]):
        axis.legend(loc="upper right", fontsize=8, frameon=False)
    return axes


def phase(response: Response, axis=None):
    """Draw the orbit in the phase plane, with the stable manifold of the upright saddles.

    **Arguments:**

    - `response`: result of `simulate`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis. Without forcing, a block outside the band between the manifolds overturns.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 5), layout="constrained")
    scene = response.stepper.scene
    alpha = float(scene.alpha)
    _, rotation, velocity = _dense(response)
    # The line breaks at impacts: the velocity jumps there.
    crossed = np.flatnonzero(np.diff(np.sign(rotation)) != 0) + 1
    axis.plot(np.insert(rotation, crossed, np.nan), np.insert(velocity, crossed, np.nan), color=_BLUE, linewidth=0.8)
    opening = np.linspace(0, 2, 101)
    manifold = np.asarray(jax.vmap(scene.table.manifold)(jnp.asarray(opening * alpha))) / alpha
    for side in (1, -1):
        label = "stable manifold" if side > 0 else None
        axis.plot(side * opening, side * manifold, color=_RED, linewidth=1, label=label)
        axis.plot(side * opening, -side * manifold, color=_RED, linewidth=0.7, linestyle=":")
        axis.plot([side * float(scene.table.saddle) / alpha], [0], "o", color=_RED, markersize=4)
    axis.axvline(0, color=_GREY, linewidth=0.5)
    reach = max(1.1, 1.1 * float(np.max(np.abs(rotation[np.abs(rotation) < 2.5]), initial=0)))
    axis.set_xlim(-reach, reach)
    axis.set_ylim(-max(1.2, 1.1 * np.max(np.abs(velocity[np.abs(rotation) < reach]), initial=0)), None)
    axis.set_ylim(axis.get_ylim()[0], -axis.get_ylim()[0])
    axis.set_xlabel(r"rotation $\theta/\alpha$")
    axis.set_ylabel(r"velocity $\dot\theta/(p\alpha)$")
    axis.legend(loc="upper right", fontsize=8, frameon=False)
    return axis


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
        colors = plt.colormaps["viridis"](np.linspace(0, 0.85, len(values))) if len(values) > 1 else [_BLUE]
        for i, (curve, color) in enumerate(zip(values, colors)):
            label = None if result.intensity is None else f"{float(result.intensity[i]):g}"
            axis.plot(abscissa, curve, color=color, linewidth=1, label=label)
        axis.set_ylim(bottom=0)
        lost = rows.any(axis=0)
        if lost.any():
            where = lost if len(values) == 1 else rows.all(axis=0)
            axis.fill_between(
                abscissa, 0, 1, where=where, transform=axis.get_xaxis_transform(), color=_RED, alpha=0.15,
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
    colors = ("black", "#f3efe6", _BLUE, _RED)
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
    handles = [Patch(facecolor=colors[i + 1], edgecolor=_GREY, label=names[i + 1]) for i in shown]
    axis.legend(handles=handles, loc="upper left", fontsize=8)
    axis.set_xlabel(r"frequency ratio $\omega/p$")
    axis.set_ylabel("intensity (peak acceleration / uplift threshold)")
    return axis


def safety_regions(shape: float, axis=None, *, longest: float = 8.0, points: int = 400):
    """Draw what becomes of a slender block under a single-lobe pulse of one shape, from closed forms.

    **Arguments:**

    - `shape`: of the pulse, from -inf (rectangle) to +inf (spike).
    - `axis`: matplotlib axis; None makes a figure.
    - `longest`: largest pulse duration p t_d. `points`: along each curve.

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
    colors = ("#8e1f18", _RED, "#e08a80", "#cfe0ea", "#f3efe6")
    names = ("$O_1$: past α as the pulse rises", "$O_2$: as it falls", "$O_3$: after it",
             "$S_2$: safe, peak after the pulse", "$S_1$: safe, peak while it falls")  # fmt: skip
    for lower, upper, color, name in zip(edges, edges[1:], colors, names):
        axis.fill_between(duration, lower, upper, color=color, linewidth=0, label=name)
    axis.plot(duration, curves[2], color="black", linewidth=1.2)
    axis.set(xlim=(0, longest), ylim=(0, 1), xlabel="pulse duration $p\\,t_d$", ylabel="uplift strength $g\\alpha/A_g$")
    axis.legend(loc="lower right", fontsize=7)
    return axis


def sine_regions(restitution: float, axis=None, *, frequency_ratio=None):
    """Draw the closed-form curves of overturning under one cycle of a sine over an axis or a map.

    **Arguments:**

    - `restitution`: in [0, 1].
    - `axis`: matplotlib axis, such as `overturning` returns; None makes a figure.
    - `frequency_ratio`: (n,) omega/p; None: 0.3 to 8.

    **Returns:** the axis.

    **Source:** Dimitrakopoulos & DeJong (2012), figure 4: equations 3.10, 3.18, 3.20 with 3.21, and 3.31.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5, 4), layout="constrained")
    ratio = np.linspace(0.3, 8, 300) if frequency_ratio is None else np.asarray(frequency_ratio, float)
    after = [np.asarray(x) for x in sine_pulse.after_pulse_limits(ratio, restitution)]
    limit = np.asarray(sine_pulse.impact_time_limit(ratio))
    curves = {
        "case 2: no impact": (sine_pulse.no_impact_limit(ratio), "black", "-"),
        "case 1.2: impact after the pulse": (after[1], "#0d2f4a", "-"),
        None: (np.where(after[0] > limit, after[0], np.inf), "#0d2f4a", "-"),
        "case 1.1: impact during the pulse": (sine_pulse.during_pulse_limit(ratio, restitution), "#7a1a14", "-"),
        "first impact as the pulse ends": (limit, _GREY, "--"),
    }
    for name, (curve, color, style) in curves.items():
        curve = np.where(np.isfinite(curve), curve, np.nan)
        axis.plot(ratio, curve, color=color, linestyle=style, linewidth=1.2, label=name)
    axis.set(xlabel=r"frequency ratio $\omega/p$", ylabel="intensity $a_g/g\\alpha$")
    axis.legend(loc="upper left", fontsize=7)
    return axis


def tornado(found: Sensitivity, result: str = "max_rotation", axis=None):
    """Draw the elasticities of one result as bars, the largest on top.

    **Arguments:**

    - `found`: result of `sensitivity`, of one scene.
    - `result`: "max_rotation", "max_velocity" or "margin".
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5, 3), layout="constrained")
    elasticity = np.asarray(getattr(found, result).elasticity)
    order = np.argsort(np.abs(elasticity))
    names = [found.names[k].replace("_", " ") for k in order]
    axis.barh(names, elasticity[order], color=[_BLUE if x > 0 else _RED for x in elasticity[order]], height=0.6)
    axis.axvline(0, color="black", linewidth=0.8)
    axis.set_xlabel(f"{result.replace('_', ' ')}: per cent for one per cent")
    return axis


def sensitivity_map(found: SensitivityMap, parameter: str, result: str = "max_rotation", axis=None, *, limit=None):
    """Draw the elasticity of one result by one parameter over pulse duration and uplift strength.

    Blocks that overturn, and responses that are not smooth there, are left grey.

    **Arguments:**

    - `found`: result of `sensitivity_map`.
    - `parameter`: one of its names, such as "shape" or "uplift_strength".
    - `result`: "max_rotation", "max_velocity" or "margin".
    - `axis`: matplotlib axis; None makes a figure. `limit`: end of the colour scale; None: the 98th percentile.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5, 4), layout="constrained")
    sensitivity = found.sensitivity
    values = np.asarray(getattr(sensitivity, result).elasticity)[..., sensitivity.names.index(parameter)]
    known = np.isfinite(values)
    if limit is None:
        limit = max(float(np.percentile(np.abs(values[known]), 98)), 1e-12) if known.any() else 1.0
    axis.set_facecolor("#d5d5d5")
    x, y = np.asarray(found.pulse_duration), np.asarray(found.uplift_strength)
    picture = axis.pcolormesh(x, y, values, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="nearest", rasterized=True)
    axis.figure.colorbar(picture, ax=axis, label="elasticity")
    axis.set_title(f"{result.replace('_', ' ')} by {parameter.replace('_', ' ')}")
    axis.set(xlabel="pulse duration $p\\,t_d$", ylabel="uplift strength (threshold/amplitude)")
    return axis


def critical(abscissa, found: Critical, axis=None):
    """Draw all intensities at which blocks begin or cease to overturn, for many scenes side by side.

    **Arguments:**

    - `abscissa`: (scenes,) what the scenes differ by, such as periods [s].
    - `found`: result of `critical_amplitudes` for many scenes.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    x = np.broadcast_to(np.asarray(abscissa)[:, None], found.intensity.shape)
    there = np.isfinite(np.asarray(found.intensity))
    rising, impacts = np.asarray(found.rising), np.asarray(found.impacts)
    kinds = (
        ("overturns above: without impact", _RED, rising & (impacts == 0)),
        ("overturns above: after impacts", _BLUE, rising & (impacts > 0)),
        ("safe again above", _SAND, ~rising),
    )
    for name, color, kind in kinds:
        axis.plot(
            x[there & kind], np.asarray(found.intensity)[there & kind], ".", color=color, markersize=3, label=name
        )
    axis.set_ylabel("intensity: amplitude/threshold")
    axis.legend(fontsize=8, frameon=False)
    return axis


def fragility(found: SimulatedFragility, fit: LogNormalFragility | None = None, axis=None):
    """Draw the share of blocks that topple against the level of shaking, and between which bounds it is known.

    **Arguments:**

    - `found`: result of `simulated_fragility`.
    - `fit`: a lognormal fragility to draw over it, such as `found.fit().fragility`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
    levels = np.asarray(found.levels)
    axis.plot(levels, found.lower, "o-", color=_BLUE, markersize=3, linewidth=0.8, label="simulated")
    if found.undecided:
        axis.fill_between(levels, found.lower, found.upper, color=_SAND, alpha=0.6, linewidth=0, label="undecided")
    if fit is not None:
        dense = np.geomspace(levels[0], levels[-1], 300)
        label = f"lognormal: {float(fit.median):.3g}, {float(fit.dispersion):.2g}"
        axis.plot(dense, fit(dense), color=_RED, linewidth=1.2, label=label)
    unit = {"PGA": "PGA [g]", "PGV": "PGV [m/s]"}[found.measure]
    axis.set(xscale="log", xlabel=unit, ylabel="probability to topple", ylim=(-0.02, 1.02))
    axis.legend(loc="upper left", fontsize=8, frameon=False)
    return axis


def fragility_surface(
    found: SimulatedSurface, fit: SurfaceFragility | None = None, axis=None, *, contours=(0.05, 0.5, 0.95)
):
    """Draw the share of blocks that topple over PGV/PGA and peak acceleration, with contours.

    **Arguments:**

    - `found`: result of `simulated_surface`. What is undecided is drawn at the middle of its bounds.
    - `fit`: a `SurfaceFragility` whose contours are drawn over it, dashed.
    - `axis`: matplotlib axis; None makes a figure. `contours`: probabilities.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 4), layout="constrained")
    ratio, acceleration = np.asarray(found.ratio), np.asarray(found.acceleration)
    share = (found.lower + found.upper) / 2
    picture = axis.pcolormesh(
        ratio, acceleration, share, cmap="YlOrBr", vmin=0, vmax=1, shading="nearest", rasterized=True
    )
    axis.figure.colorbar(picture, ax=axis, label="probability to topple")
    lines = axis.contour(ratio, acceleration, share, levels=contours, colors="black", linewidths=1)
    axis.clabel(lines, fmt=lambda p: f"{100 * p:g} %", fontsize=7)
    if fit is not None:
        for probability in contours:
            axis.plot(ratio, fit.acceleration(probability, ratio), "--", color=_BLUE, linewidth=1)
    axis.set(xlabel="PGV/PGA [s]", ylabel="PGA [g]", ylim=(acceleration[0], acceleration[-1]))
    return axis


def history_fit(found: HistoryFit, time, axes=None):
    """Draw a measured and a fitted history, and what is left between them.

    **Arguments:**

    - `found`: result of `fit_history`; `time`: (n,) of the measurements [s].
    - `axes`: two matplotlib axes; None makes a figure.

    **Returns:** the axes.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4), layout="constrained", height_ratios=(2, 1))
    alpha = float(found.block.alpha)
    axes[0].plot(time, (found.rotation + found.residuals) / alpha, ".", color=_GREY, markersize=3, label="measured")
    axes[0].plot(time, found.rotation / alpha, color=_BLUE, linewidth=1, label="fitted")
    axes[1].plot(time, found.residuals / alpha, ".", color=_RED, markersize=3)
    axes[1].axhline(0, color=_GREY, linewidth=0.5)
    axes[0].set_ylabel(r"rotation $\theta/\alpha$")
    axes[1].set(xlabel="time [s]", ylabel="residual")
    axes[0].legend(fontsize=8, frameon=False, loc="upper right")
    return axes
