"""Figures of one response: history, and orbit in the phase plane."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.flexible.response import FlexibleResponse
from jaxrock.models.coefficients import Coefficients
from jaxrock.motions.mirrored import has_vertical
from jaxrock.motions.motion import AbstractMotion
from jaxrock.plot.style import BLUE, GREY, RED, SAND, figure
from jaxrock.responses.history import Response
from jaxrock.status import Status, is_decided

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_POINTS = 20_001  # points of a curve
_LONG = 200.0  # [s] longest response with equal steps alone, which are then at most 0.01 s


def acceleration_of(motion: AbstractMotion, time: np.ndarray) -> np.ndarray:
    """Return the ground acceleration at times [g]."""
    return np.asarray(motion.acceleration(time))


def moments_seen(motion: AbstractMotion, begin: float, end: float, count: int) -> np.ndarray:
    """Return times at which a motion is drawn [s]: equal steps, as many in curved pieces, and all knots between.

    Each knot comes with the moment before it, which draws jumps.
    """
    knots = np.asarray(motion.knots)
    # Clip knots outside instead of dropping them: a fixed number of times needs one program for padded records.
    within = np.clip(np.concatenate([knots, np.nextafter(knots, -np.inf), _curved(motion, knots, count)]), begin, end)
    return np.sort(np.concatenate([np.linspace(begin, end, count), within]))


def _curved(motion: AbstractMotion, knots: np.ndarray, count: int) -> np.ndarray:
    """Return times within curved pieces, denser where the acceleration changes faster."""
    if motion.scales is None:
        return knots[:0]
    lengths, scales = np.asarray(motion.lengths), np.asarray(motion.scales)
    curved = np.isfinite(scales)
    scales = np.where(curved, scales, 1.0)
    changes = np.cumsum(np.where(curved, lengths / scales, 0.0))
    share = changes[-1] * (np.arange(count) + 0.5) / count
    piece = np.minimum(np.searchsorted(changes, share), lengths.size - 1)
    return knots[piece] + (share - np.append(0.0, changes)[piece]) * scales[piece]


def _times_of(response: Response | FlexibleResponse, motion: AbstractMotion) -> np.ndarray:
    """Return times at which a response is drawn [s]: equal steps, which would pass over events of a long response.

    A long one has half of its times between knots and impacts, equally many between any two.
    """
    duration = float(response.duration)
    if duration <= _LONG:
        return np.linspace(0, duration, _POINTS)
    events = np.concatenate([[0.0, duration], np.asarray(motion.knots), np.asarray(response.impact_times)])
    events = np.unique(events[(events >= 0) & (events <= duration)])
    half = np.interp(np.linspace(0, events.size - 1, _POINTS // 2), np.arange(events.size), events)
    return np.sort(np.concatenate([half, np.linspace(0, duration, _POINTS - half.size)]))


@jax.jit
def _vertical(motion: AbstractMotion, time: jax.Array) -> jax.Array:
    knots = motion.knots

    def at(t):
        piece = jnp.clip(jnp.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
        series = motion.vertical_series(piece, t - knots[piece], jnp.ones_like(t), 0)
        return jnp.where((t >= 0) & (t < knots[-1]), series[0], 0.0)

    return jax.vmap(at)(jnp.asarray(time, knots.dtype))


def vertical_of(motion: AbstractMotion, time: np.ndarray) -> np.ndarray | None:
    """Return the vertical acceleration at times (n,) [g], positive upward; None if the motion has none."""
    return np.asarray(_vertical(motion, time)) if has_vertical(motion) else None


def why_not(status: Status) -> str:
    """Return a short reason for a response without a result, "no result: ..."; otherwise an empty string."""
    if bool(np.asarray(is_decided(status))):
        return ""
    reason = re.split("[,:.]", Status[status])[0]
    return f"no result: {reason[0].lower()}{reason[1:]}"


def _say_why_not(axis: "Axes", status: Status) -> None:
    if said := why_not(status):
        axis.set_title(said, color=RED, fontsize=9)


def _ink() -> str:
    """Return matplotlib's colour of text, which is legible on the background in use."""
    import matplotlib

    return matplotlib.rcParams["text.color"]


def _dense(response: Response) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time [s], rotation over alpha and velocity over p alpha, dense enough for the corners at impacts."""
    scene = response.scene
    time = _times_of(response, scene.motion)
    rotation, velocity = response(time)
    alpha, p = float(scene.alpha), float(scene.p)
    return time, np.asarray(rotation) / alpha, np.asarray(velocity) / (p * alpha)


@figure(3)
def history(response: Response | FlexibleResponse, axes: "Sequence[Axes] | None" = None) -> "Sequence[Axes]":
    """Draw rotation over alpha, velocity over p alpha and ground acceleration against time, impacts marked.

    A vertical acceleration is drawn with the horizontal one, and changes the threshold. A title marks a response
    without a result.

    **Arguments:**

    - `response`: result of `simulate`. For a flexible block, the displacement of its top, and the bending part of it,
      replace the velocity.
    - `axes`: three matplotlib axes; None makes a figure.

    **Returns:** the three axes. For an asymmetric block alpha is the smaller slenderness angle, and each direction has
    its own threshold. A wall that opens to one side has one threshold.

    **Raises:** ValueError for the response of many scenes.
    """
    import matplotlib.pyplot as plt

    response.trajectory.check_single()
    if axes is None:
        _, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 6), layout="constrained")
    _say_why_not(axes[0], response.status)
    if isinstance(response, FlexibleResponse):
        return _bending_history(response, axes)
    scene = response.scene
    time, rotation, velocity = _dense(response)
    shaken = moments_seen(scene.motion, 0.0, time[-1], _POINTS)
    impacts = np.asarray(response.impact_times)
    speeds = np.asarray(response.impact_velocities) / (float(scene.p) * float(scene.alpha))
    axes[0].plot(time, rotation, color=BLUE, linewidth=0.9)
    axes[1].plot(time, velocity, color=BLUE, linewidth=0.9)
    axes[2].plot(shaken, acceleration_of(scene.motion, shaken), color=_ink(), linewidth=0.9)
    for axis in axes:
        axis.axhline(0, color=GREY, linewidth=0.5)
    axes[0].plot(impacts, np.zeros_like(impacts), "|", color=RED, markersize=7, label="impact")
    axes[1].plot(impacts, speeds, ".", color=RED, markersize=3)
    vertical = vertical_of(scene.motion, shaken)
    if vertical is not None:
        axes[2].plot(shaken, vertical, color=GREY, linewidth=0.6, label="vertical")
    for side, moments in zip((1, -1), scene.both_moments):  # positive acceleration lifts it to side -1
        if scene.only_side not in (None, side):
            continue
        label, level = "uplift threshold" if side > 0 or scene.only_side else None, -side * float(moments.threshold)
        if vertical is None:
            axes[2].axhline(level, color=SAND, linewidth=0.9, label=label)
        else:  # upward acceleration adds to gravity, and raises the threshold
            axes[2].plot(shaken, level * (1 + vertical), color=SAND, linewidth=0.9, label=label)
    axes[0].set_ylabel(r"rotation $\theta/\alpha$")
    axes[1].set_ylabel(r"velocity $\dot\theta/(p\alpha)$")
    axes[2].set_ylabel("ground\nacceleration [g]")
    axes[2].set_xlabel("time [s]")
    axes[0].legend(loc="upper right", fontsize=8, frameon=False)
    axes[2].legend(loc="upper right", fontsize=8, framealpha=0.9, edgecolor="none")  # lines pass below the legend
    return axes


def _bending_history(response: FlexibleResponse, axes):
    time = _times_of(response, response.scene.ground)
    rotation, displacement, bending = (np.asarray(x) for x in response(time))
    impacts = np.asarray(response.impact_times)
    axes[0].plot(time, rotation / float(response.scene.block.alpha), color=BLUE, linewidth=0.9)
    axes[0].plot(impacts, np.zeros_like(impacts), "|", color=RED, markersize=7, label="impact")
    axes[1].plot(time, displacement, color=BLUE, linewidth=0.9, label="top")
    axes[1].plot(time, bending, color=SAND, linewidth=0.7, label="of it bending")
    ground = response.scene.ground
    shaken = moments_seen(ground, 0.0, time[-1], _POINTS)
    axes[2].plot(shaken, acceleration_of(ground, shaken), color=_ink(), linewidth=0.9)
    labels = (r"rotation of the base $\theta/\alpha$", "displacement [m]", "ground\nacceleration [g]")
    for axis, label in zip(axes, labels):
        axis.axhline(0, color=GREY, linewidth=0.5)
        axis.set_ylabel(label)
    axes[2].set_xlabel("time [s]")
    for axis in axes[:2]:
        axis.legend(loc="upper right", fontsize=8, frameon=False)
    return axes


@jax.jit
def _manifolds(moments: Coefficients, opening):
    return jax.vmap(moments.manifold)(opening)


def _manifold(axis: "Axes", moments: Coefficients, side: int, alpha: float) -> float:
    """Draw the stable manifold of the upright saddle of a side, and the unstable one, dotted.

    Return the normalised speed of the manifold at zero rotation.
    """
    opening = np.linspace(0, 2 * max(1.0, float(moments.saddle) / alpha), 101)
    manifold = np.asarray(_manifolds(moments, opening * alpha)) / alpha
    label = "stable manifold" if side > 0 else None
    axis.plot(side * opening, side * manifold, color=RED, linewidth=1, label=label)
    axis.plot(side * opening, -side * manifold, color=RED, linewidth=0.7, linestyle=":")
    return abs(float(manifold[0]))


@figure(1)
def phase(response: Response | FlexibleResponse, axis: "Axes | None" = None) -> "Axes":
    """Draw the orbit in the phase plane, with the stable manifold of the upright saddles.

    **Arguments:**

    - `response`: result of `simulate`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis. Without forcing, a block outside the band between the manifolds overturns. For an `Equation`,
    which is defined by functions, only the equilibria are drawn.

    **Raises:** ValueError for the response of a flexible block, or of many scenes.
    """
    import matplotlib.pyplot as plt

    if isinstance(response, FlexibleResponse):
        raise ValueError(
            "Argument `response` must be of a rigid block, but is a FlexibleResponse, whose orbit is in no plane: use "
            "`plot.history`."
        )
    response.trajectory.check_single()
    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 5), layout="constrained")
    _say_why_not(axis, response.status)
    scene = response.scene
    alpha = float(scene.alpha)
    _, rotation, velocity = _dense(response)
    # The line breaks at impacts: the velocity jumps there.
    crossed = np.flatnonzero(np.diff(np.sign(rotation)) != 0) + 1
    axis.plot(np.insert(rotation, crossed, np.nan), np.insert(velocity, crossed, np.nan), color=BLUE, linewidth=0.8)
    saddles, speed = {}, 1.0
    for side, moments in zip((1, -1), scene.both_moments):
        saddles[side] = float(moments.saddle) / alpha
        if isinstance(moments, Coefficients):  # moments given by functions have no known manifold
            speed = max(speed, _manifold(axis, moments, side, alpha))
        axis.plot([side * saddles[side]], [0], "o", color=RED, markersize=4)
    axis.axvline(0, color=GREY, linewidth=0.5)
    seen = (rotation < 2.5 * max(1.0, saddles[1])) & (rotation > -2.5 * max(1.0, saddles[-1]))
    reach = max(1.0, np.max(np.abs(rotation[seen]), initial=0))
    axis.set_xlim(-1.1 * max(reach, saddles[-1]), 1.1 * max(reach, saddles[1]))
    shown = (rotation > axis.get_xlim()[0]) & (rotation < axis.get_xlim()[1])
    highest = max(1.2 * speed, 1.1 * np.max(np.abs(velocity[shown]), initial=0))
    axis.set_ylim(-highest, highest)
    axis.set_xlabel(r"rotation $\theta/\alpha$")
    axis.set_ylabel(r"velocity $\dot\theta/(p\alpha)$")
    if axis.get_legend_handles_labels()[0]:
        axis.legend(loc="upper right", fontsize=8, frameon=False)
    return axis
