"""Figures of one response: history, and orbit in the phase plane."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxrock.flexible.response import FlexibleResponse
from jaxrock.models.coefficients import Coefficients
from jaxrock.motions.motion import AbstractMotion
from jaxrock.plot.style import BLUE, GREY, RED, SAND, figure
from jaxrock.responses.history import Response

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def acceleration_of(motion: AbstractMotion, time: np.ndarray) -> np.ndarray:
    """Ground acceleration at times [g]."""
    return np.asarray(motion.acceleration(time))


def _ink() -> str:
    """The colour of text, which is seen on any background."""
    import matplotlib

    return matplotlib.rcParams["text.color"]


def _dense(response: Response) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], rotation over alpha and velocity over p alpha, finely enough for the corners at impacts."""
    scene = response.scene
    time = np.linspace(0, float(response.duration), 20001)
    rotation, velocity = response(time)
    alpha, p = float(scene.alpha), float(scene.p)
    return time, np.asarray(rotation) / alpha, np.asarray(velocity) / (p * alpha)


@figure(3)
def history(response: Response | FlexibleResponse, axes: "Sequence[Axes] | None" = None) -> "Sequence[Axes]":
    """Draw rotation over alpha, velocity over p alpha and ground acceleration against time, impacts marked.

    **Arguments:**

    - `response`: result of `simulate`; of a flexible block the displacement of its top, and the part of it that is
      bending, take the place of the velocity.
    - `axes`: three matplotlib axes; None makes a figure.

    **Returns:** the three axes. Of an asymmetric block alpha is the smaller slenderness angle, and each way has its own
    threshold.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 6), layout="constrained")
    if isinstance(response, FlexibleResponse):
        return _bending_history(response, axes)
    scene = response.scene
    time, rotation, velocity = _dense(response)
    acceleration = acceleration_of(scene.motion, time)
    impacts = np.asarray(response.impact_times)
    speeds = np.asarray(response.impact_velocities) / (float(scene.p) * float(scene.alpha))
    for axis, curve in zip(axes, (rotation, velocity, acceleration)):
        axis.plot(time, curve, color=BLUE if axis is not axes[2] else _ink(), linewidth=0.9)
        axis.axhline(0, color=GREY, linewidth=0.5)
    axes[0].plot(impacts, np.zeros_like(impacts), "|", color=RED, markersize=7, label="impact")
    axes[1].plot(impacts, speeds, ".", color=RED, markersize=3)
    for side, moments in zip((1, -1), scene.both_moments):  # positive acceleration lifts it to side -1
        label = "uplift threshold" if side > 0 else None
        axes[2].axhline(-side * float(moments.threshold), color=SAND, linewidth=0.9, label=label)
    axes[0].set_ylabel(r"rotation $\theta/\alpha$")
    axes[1].set_ylabel(r"velocity $\dot\theta/(p\alpha)$")
    axes[2].set_ylabel("ground\nacceleration [g]")
    axes[2].set_xlabel("time [s]")
    axes[0].legend(loc="upper right", fontsize=8, frameon=False)
    axes[2].legend(loc="upper right", fontsize=8, framealpha=0.9, edgecolor="none")  # the lines go through it
    return axes


def _bending_history(response: FlexibleResponse, axes):
    time = np.linspace(0, float(response.duration), 20001)
    rotation, displacement, bending = (np.asarray(x) for x in response(time))
    impacts = np.asarray(response.impact_times)
    axes[0].plot(time, rotation / float(response.scene.block.alpha), color=BLUE, linewidth=0.9)
    axes[0].plot(impacts, np.zeros_like(impacts), "|", color=RED, markersize=7, label="impact")
    axes[1].plot(time, displacement, color=BLUE, linewidth=0.9, label="top")
    axes[1].plot(time, bending, color=SAND, linewidth=0.7, label="of it bending")
    axes[2].plot(time, acceleration_of(response.scene.ground, time), color=_ink(), linewidth=0.9)
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


def _manifold(axis: "Axes", moments: Coefficients, side: int, alpha: float) -> None:
    """The stable manifold of the upright saddle of a side, and the unstable one, dotted."""
    opening = np.linspace(0, 2 * max(1.0, float(moments.saddle) / alpha), 101)
    manifold = np.asarray(_manifolds(moments, opening * alpha)) / alpha
    label = "stable manifold" if side > 0 else None
    axis.plot(side * opening, side * manifold, color=RED, linewidth=1, label=label)
    axis.plot(side * opening, -side * manifold, color=RED, linewidth=0.7, linestyle=":")


@figure(1)
def phase(response: Response | FlexibleResponse, axis: "Axes | None" = None) -> "Axes":
    """Draw the orbit in the phase plane, with the stable manifold of the upright saddles.

    **Arguments:**

    - `response`: result of `simulate`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis. Without forcing, a block outside the band between the manifolds overturns. Of an `Equation`,
    which is functions, the equilibria are drawn alone.

    **Raises:** ValueError for the response of a flexible block.
    """
    import matplotlib.pyplot as plt

    if isinstance(response, FlexibleResponse):
        raise ValueError(
            "Argument `response` must be of a rigid block, but is a FlexibleResponse, whose orbit is in no plane: use "
            "`plot.history`."
        )
    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 5), layout="constrained")
    scene = response.scene
    alpha = float(scene.alpha)
    _, rotation, velocity = _dense(response)
    # The line breaks at impacts: the velocity jumps there.
    crossed = np.flatnonzero(np.diff(np.sign(rotation)) != 0) + 1
    axis.plot(np.insert(rotation, crossed, np.nan), np.insert(velocity, crossed, np.nan), color=BLUE, linewidth=0.8)
    for side, moments in zip((1, -1), scene.both_moments):
        if isinstance(moments, Coefficients):  # of functions no manifold is known
            _manifold(axis, moments, side, alpha)
        axis.plot([side * float(moments.saddle) / alpha], [0], "o", color=RED, markersize=4)
    axis.axvline(0, color=GREY, linewidth=0.5)
    reach = max(1.1, 1.1 * float(np.max(np.abs(rotation[np.abs(rotation) < 2.5]), initial=0)))
    axis.set_xlim(-reach, reach)
    axis.set_ylim(-max(1.2, 1.1 * np.max(np.abs(velocity[np.abs(rotation) < reach]), initial=0)), None)
    axis.set_ylim(axis.get_ylim()[0], -axis.get_ylim()[0])
    axis.set_xlabel(r"rotation $\theta/\alpha$")
    axis.set_ylabel(r"velocity $\dot\theta/(p\alpha)$")
    if axis.get_legend_handles_labels()[0]:
        axis.legend(loc="upper right", fontsize=8, frameon=False)
    return axis
