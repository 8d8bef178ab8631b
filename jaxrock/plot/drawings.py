"""Draw scenes to scale: a block or the column that models it, the ground, the motion, and their symbols."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import declared
from jaxrock._arguments.ranges import Range, scalar, strength
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.cantilever import unit_column
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.blocks.rigid import Block
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.models.spring import Spring
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.pulse import AbstractPulse
from jaxrock.plot.bodies import AnyBlock, Body, Shapes, turned
from jaxrock.plot.responses import acceleration_of, moments_seen
from jaxrock.plot.restrained import draw_frame, draw_restraints
from jaxrock.plot.style import BLUE, GREY, RED, SAND, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from matplotlib.patches import Polygon

_turn = Range("be in [-pi/2, pi/2]", -np.pi / 2, np.pi / 2, lambda x: abs(x) <= np.pi / 2 + 1e-6)
_PAPER = "#efe3c8"
_INK: dict[str, Any] = {"color": "black", "linewidth": 0.8}


@figure(1)
def scene(
    block: AnyBlock,
    motion: AbstractMotion | None = None,
    axis: "Axes | None" = None,
    *,
    model: AbstractEquation = Housner(),
    rotation: ArrayLike = 0.0,
    bending: ArrayLike = 0.0,
) -> "Axes":
    """Draw a block, or the spring or column that models it, to scale and with its symbols, and the motion below it.

    Corner O is that of positive rotations; the ground's acceleration is positive to the right. A block defined by
    slenderness and frequency alone is drawn as the rectangle of that p. An asymmetric one is drawn as the parallelogram
    with its corners and its centre of mass. What stands behind a wall that opens to one side is drawn hatched. A frame
    is drawn as two columns under its beam; tendons, ties and dampers are red.

    **Arguments:**

    - `block`: a `Block`, `AsymmetricBlock` or `FlexibleBlock` of scalars; `motion`: any motion; None leaves it out.
    - `axis`: matplotlib axis; None makes a figure.
    - `model`: as in `outcome`. A `Spring` adds its column, with the block behind it; a `Rolling` adds the block's
      edges; restraints are added where they act.
    - `rotation`: rotation of the drawn block [rad], in [-pi/2, pi/2].
    - `bending`: displacement of the top of a flexible block by bending, in its first clamped mode [m].

    **Returns:** the axis.

    **Raises:** ValueError for arguments outside their ranges, arrays in place of scalars, and `bending` of a block that
    does not bend.

    **Source:** Voyagaki et al. (2012), figure 2.1; Dimitrakopoulos & DeJong (2012), figure 1; Diamantopoulos &
    Fragiadakis (2017), figures 1, 2, 4, 6, 8 and 10.
    """
    rotation = float(scalar("rotation", _turn("rotation", rotation)))
    bent = float(scalar("bending", strength("bending", bending)))
    if bent and not isinstance(block, FlexibleBlock):
        raise ValueError(f"Argument `bending` must be zero for a {type(block).__name__}, which does not bend.")
    body = Body.of(block, model)
    if axis is None:
        axis = _axis_over(motion)
    column = None
    if bent and isinstance(block, FlexibleBlock):
        shape = unit_column(block.masses).shapes[:, 0]
        column = bent * np.concatenate([[0.0], shape / shape[-1]])
    shapes = body.pose(rotation, column)
    draw_ground(axis, body, block.only_side if isinstance(block, Block) else None)
    outline, *_ = draw(axis, body, shapes)
    beam = np.zeros((0, 2))
    if isinstance(block, Block):
        if block.beam is not None:
            beam = draw_frame(axis, body, shapes, {"facecolor": outline.get_facecolor(), "edgecolor": "black"})
        draw_restraints(axis, body, model, rotation, block)
    if isinstance(block, AsymmetricBlock):
        _sides(axis, body, rotation)
    else:
        _symbols(axis, body, rotation, isinstance(model, Spring) or isinstance(block, FlexibleBlock))
    every = np.concatenate([shapes.outline, shapes.column, [body.right, body.left], beam])
    room = 0.2 * body.size
    axis.set(xlim=(every[:, 0].min() - 1.6 * room, every[:, 0].max() + 1.6 * room))
    axis.set(ylim=(-1.35 * room, every[:, 1].max() + room), aspect="equal")
    axis.set_axis_off()
    if motion is not None:
        _motion(axis.inset_axes((0.1, -0.36, 0.8, 0.28)), motion)
    return axis


def _axis_over(motion: AbstractMotion | None) -> "Axes":
    """Return a new axis, with room for a motion below it; a constrained layout would cut that inset off."""
    import matplotlib.pyplot as plt

    if motion is None:
        return plt.subplots(figsize=(5, 5), layout="constrained")[1]
    figure, axis = plt.subplots(figsize=(5, 6.5))
    figure.subplots_adjust(left=0.06, right=0.94, bottom=0.33, top=0.98)
    axis.set_anchor("N")
    return axis


def draw_ground(axis: "Axes", body: Body, only_side: int | None = None) -> None:
    """Draw the ground with its hatching, and what stands behind a wall that opens to one side."""
    from matplotlib.patches import Polygon

    size, (right, left) = body.size, (body.right, body.left)
    surface = [[-3 * size, left[1]], left, right, [3 * size, right[1]]]
    depth = -0.06 * size
    axis.add_patch(Polygon([*surface, [3 * size, depth], [-3 * size, depth]], facecolor="white", edgecolor=GREY,
                           hatch="////", linewidth=0))  # fmt: skip
    axis.plot(*np.transpose(surface), **_INK)
    if only_side is not None:
        face, high = (left if only_side > 0 else right)[0], body.outline[:, 1].max()
        back = face + only_side * depth
        behind = [[face, 0.0], [face, high], [back, high], [back, 0.0]]
        axis.add_patch(Polygon(behind, facecolor="white", edgecolor=GREY, hatch="////", linewidth=0, zorder=0.5))
        axis.plot([face, face], [0.0, high], **_INK, zorder=0.6)


def draw(axis: "Axes", body: Body, shapes: Shapes) -> "tuple[Polygon, Line2D, Line2D]":
    """Draw the block with its column and spring; return outline, column and masses as artists that can be moved."""
    from matplotlib.patches import Polygon

    modelled = bool(body.heights.size)
    look: dict[str, Any] = (
        {"facecolor": "#f7f2e6", "edgecolor": GREY, "linestyle": "--"} if modelled else {"facecolor": _PAPER}
    )
    outline = Polygon(shapes.outline, **({"edgecolor": "black", "linewidth": 1.0} | look))
    axis.add_patch(outline)
    (column,) = axis.plot(*shapes.column.T, color=BLUE, linewidth=2.5, solid_capstyle="round")
    (masses,) = axis.plot(*shapes.masses.T, "o", color="black", markersize=6)
    if modelled:
        turns = np.linspace(0, 4 * np.pi, 120)
        spiral = 0.05 * body.size * turns / turns[-1]
        axis.plot(spiral * np.cos(turns), spiral * np.sin(turns), color=RED, linewidth=1.0, zorder=4)
    return outline, column, masses


def _between(
    axis: "Axes", start: np.ndarray, end: np.ndarray, label: str, offset: Any = (0.0, 0.0), ha: str = "center"
) -> None:
    """Draw a dimension: an arrow with two heads and its symbol."""
    axis.annotate("", start, end, arrowprops={"arrowstyle": "<->", "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0})
    axis.text(*((np.add(start, end)) / 2 + offset), label, ha=ha, va="center", fontsize=11)


def _arc(axis: "Axes", centre: np.ndarray, radius: float, first: float, last: float, label: str) -> None:
    """Draw an angle between two directions [rad, counterclockwise from the right], and its symbol."""
    angle = np.linspace(first, last, 40)
    axis.plot(centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle), color=RED, linewidth=1.0)
    middle = (first + last) / 2
    place = centre + 1.16 * radius * np.array([np.cos(middle), np.sin(middle)])
    axis.text(*place, label, color=RED, ha="center", va="center", fontsize=11)


def _acceleration(axis: "Axes", body: Body) -> None:
    reach, level = 0.28 * body.size, -0.21 * body.size
    axis.annotate("", (reach, level), (-reach, level), arrowprops={"arrowstyle": "->", "color": BLUE, "linewidth": 1.4})
    axis.text(1.15 * reach, level, r"$\ddot u_g$", color=BLUE, va="center", fontsize=12)


def _symbols(axis: "Axes", body: Body, rotation: float, modelled: bool) -> None:
    """Draw the symbols of a block with two equal sides."""
    side, size = (1 if rotation >= 0 else -1), body.size
    corner, top = (body.right if side > 0 else body.left), body.outline[:, 1].max()

    def at(*place):
        return body.placed(np.array(place), rotation)

    pivot = at(*corner)
    b, gap = body.right[0], 0.08 * size
    _acceleration(axis, body)
    _between(axis, at(-b, top + gap), at(b, top + gap), "$2b$", at(0, top + 1.7 * gap) - at(0, top + gap))
    _between(axis, at(-side * (b + gap), 0), at(-side * (b + gap), top), "$2h$", at(-side * 0.8 * gap, 0) - at(0, 0))
    for corner, name in ((body.right, "$O$"), (body.left, "$O'$")):
        axis.text(corner[0] + np.sign(corner[0]) * 0.9 * gap, -0.9 * gap, name, ha="center", va="top", fontsize=11)
    if modelled:
        _column_symbols(axis, body, rotation, side)
        return
    upright, centre = np.pi / 2 - rotation, at(*body.centre)
    if abs(rotation) > 1e-9:
        axis.plot([pivot[0]] * 2, [0, 0.95 * top], color=GREY, linewidth=0.7, linestyle=":")
        _arc(axis, pivot, 0.8 * top, np.pi / 2, upright, r"$\theta$")
    axis.plot(*np.transpose([pivot, centre]), **_INK)
    axis.plot(*centre, "o", color="black", markersize=4)
    axis.text(
        *(pivot + 0.62 * (centre - pivot) - [side * 0.5 * gap, 0]),
        "$R$",
        ha="center",
        va="center",
        fontsize=11,
        color="black",
    )
    axis.text(*(centre + [0, 0.6 * gap]), "$m$", ha="center", va="center", fontsize=11, color="black")
    alpha = float(np.arctan2(body.right[0], body.centre[1]))
    _arc(axis, pivot, 0.45 * np.hypot(*body.centre), upright, upright + side * alpha, r"$\alpha$")


def _column_symbols(axis: "Axes", body: Body, rotation: float, side: int) -> None:
    """Draw the length of the column, on the side to which it leans, and its rotation, on the other."""
    length, gap = body.heights[-1], 0.08 * body.size
    full = r"$R\cos\alpha$" if length < body.centre[1] * (1 + 1e-9) else "$R$"
    name = "$2R$" if length > 1.5 * np.hypot(*body.centre) else full
    foot, head = (turned(np.array([side * 0.5 * gap, y]), np.zeros(2), rotation) for y in (0, length))
    _between(axis, foot, head, name, (side * 0.35 * gap, 0), "left" if side > 0 else "right")
    if abs(rotation) > 1e-9:
        axis.plot([0, 0], [0, length], color=GREY, linewidth=0.7, linestyle=":")
        _arc(axis, np.zeros(2), 0.8 * length, np.pi / 2, np.pi / 2 - rotation, "")
        axis.text(-side * 0.3 * gap, 0.8 * length, r"$\theta$", color=RED, ha="right" if side > 0 else "left",
                  va="center", fontsize=11)  # fmt: skip


def _sides(axis: "Axes", body: Body, rotation: float) -> None:
    """Draw the symbols of a block whose sides differ."""
    gap = 0.08 * body.size
    _acceleration(axis, body)
    centre = body.placed(body.centre, rotation)
    axis.plot(*centre, "o", color="black", markersize=4)
    for corner, side, number in ((body.right, 1, 1), (body.left, -1, 2)):
        at, upright = body.placed(corner, rotation), np.pi / 2 - rotation
        alpha = float(np.arctan2(side * (corner - body.centre)[0], body.centre[1] - corner[1]))
        reach = np.hypot(*(centre - at))
        axis.plot(*np.transpose([at, centre]), **_INK)
        axis.plot(*np.transpose([at, body.placed(corner + [0, 0.8 * reach], rotation)]), color=GREY, linewidth=0.7,
                  linestyle=":")  # fmt: skip
        axis.text(
            *(at + 0.55 * (centre - at) + [side * 0.9 * gap, 0]),
            f"$R_{number}$",
            ha="center",
            fontsize=11,
            color="black",
        )
        _arc(axis, at, 0.7 * reach, upright, upright + side * alpha, rf"$\alpha_{number}$")
        axis.text(corner[0] + side * 0.9 * gap, corner[1] - 0.9 * gap, "$O$" if side > 0 else "$O'$", ha="center",
                  va="top", fontsize=11)  # fmt: skip


def _motion(axis: "Axes", motion: AbstractMotion) -> None:
    """Draw ground acceleration against time, with the symbols of a pulse."""
    end = float(motion.end)
    time = moments_seen(motion, -0.05 * end, 1.1 * end, 1501)
    values = np.where(time < 0, 0.0, acceleration_of(motion, np.maximum(time, 0.0)))
    axis.plot(time, values, color=BLUE, linewidth=1)
    axis.axhline(0, color=GREY, linewidth=0.5)
    axis.set(xlabel="time [s]", ylabel=r"$\ddot u_g$ [g]", xlim=(time[0], time[-1]))
    axis.spines[["top", "right"]].set_visible(False)
    peak = values[np.argmax(np.abs(values))]
    axis.axhline(peak, color=SAND, linewidth=0.8, linestyle="--")
    names = list(declared(type(motion))) if isinstance(motion, AbstractPulse) else []
    amplitude = abs(float(getattr(motion, names[0]))) if names else np.inf
    is_peak = abs(abs(peak) - amplitude) < 0.01 * amplitude < np.inf  # samples may miss the peak slightly
    axis.text(time[-1], peak, r" $a_g$" if is_peak else " peak", va="center", fontsize=10)
    symbol = {"duration": "$t_d$", "period": "$T_p$"}.get(names[1]) if len(names) > 1 else None
    if symbol:
        extent = float(getattr(motion, names[1]))
        low = min(values.min(), 0.0) - 0.22 * np.ptp(values)
        start = (end - extent) / 2
        axis.annotate("", (start, low), (start + extent, low),
                      arrowprops={"arrowstyle": "<->", "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0})  # fmt: skip
        axis.text(start + extent / 2, low, symbol, ha="center", va="bottom", fontsize=10)
        axis.set_ylim(bottom=low - 0.1 * np.ptp(values))
