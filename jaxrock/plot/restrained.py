"""Draw what belongs to a rocking block: the second column and the beam of a frame, tendons, ties and dampers."""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxrock.blocks.rigid import Block
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.restraints.damper import Damper
from jaxrock.models.restraints.restraint import Restrained
from jaxrock.models.restraints.tendon import Tendon
from jaxrock.models.restraints.tie import Tie
from jaxrock.plot.bodies import Body, Shapes
from jaxrock.plot.style import RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SPACING = 1.4  # distance of the columns of a drawn frame, over their height


def draw_frame(axis: "Axes", body: Body, shapes: Shapes, look: dict[str, Any]) -> np.ndarray:
    """Draw the second column of a frame, and the beam that lies on both; return the corners of the beam [m]."""
    from matplotlib.patches import Polygon

    top = body.outline[:, 1].max()
    beside = np.array([SPACING * top, 0.0])
    axis.add_patch(Polygon(shapes.outline + beside, **look))
    highest = int(shapes.outline[:, 1].argmax())
    # The beam moves without turning, with the corners on which it lies.
    moved = shapes.outline[highest] - body.outline[highest]
    over, thick = 1.6 * body.right[0], 0.14 * top
    low, high = np.array([-over, top]), np.array([over + beside[0], top + thick])
    beam = np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) + moved
    axis.add_patch(Polygon(beam, **look))
    return beam


def draw_restraints(axis: "Axes", body: Body, model: AbstractEquation, rotation: float, block: Block) -> None:
    """Draw the restraints of a model: tendons and ties as lines, dampers as dashed ones, anchors as points.

    In a frame each column has a tendon of its own.
    """
    if not isinstance(model, Restrained):
        return
    radius = float(np.hypot(*(body.centre - body.right)))
    for restraint in model.restraints:
        look = {
            "color": RED,
            "linewidth": 1.6,
            "linestyle": "--" if isinstance(restraint, Damper) else "-",
            "zorder": 3,
        }
        height = getattr(restraint, "height", None)
        if isinstance(restraint, Tie) or (isinstance(restraint, Damper) and height is not None):
            for side in (1, -1) if block.only_side is None else (block.only_side,):
                held = np.array([(body.right if side > 0 else body.left)[0], radius * float(height)])
                anchor = held - [side * 1.7 * (body.right[0] - body.left[0]), 0.0]
                _line(axis, anchor, body.placed(held, rotation), look)
        elif isinstance(restraint, Tendon) or (isinstance(restraint, Damper) and restraint.centre):
            top = np.array([0.0, body.outline[:, 1].max()])
            for beside in (0.0,) if block.beam is None else (0.0, SPACING * top[1]):
                shift = np.array([beside, 0.0])
                _line(axis, shift, body.placed(top, rotation) + shift, look)
        elif isinstance(restraint, Damper):
            pivot = body.right if rotation >= 0 else body.left
            axis.plot(*pivot, "o", color=RED, markersize=9, fillstyle="none", zorder=4)


def _line(axis: "Axes", anchor: np.ndarray, held: np.ndarray, look: dict[str, Any]) -> None:
    axis.plot(*np.transpose([anchor, held]), **look)
    axis.plot(*np.transpose([anchor, held]), "o", color=RED, markersize=3.5, zorder=4)
