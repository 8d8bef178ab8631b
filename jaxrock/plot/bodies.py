"""Drawn shapes of blocks: outline, column and masses in metres, at any rotation."""

from typing import NamedTuple

import numpy as np

from jaxrock._arguments.parameters import check_single
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.edge import Edge
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.blocks.rigid import GRAVITY, Block
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rolling import Rolling
from jaxrock.models.spring import Spring
from jaxrock.responses.arguments import AnyBlock


class Shapes(NamedTuple):
    """The drawn shapes of a body at one moment; (n, 2) places [m]."""

    outline: np.ndarray
    column: np.ndarray
    masses: np.ndarray
    pivot: np.ndarray  # (2,)


class Body(NamedTuple):
    """A block at rest, with the origin midway between its corners on the ground, and the column that models it.

    A rigid block has no heights and masses of a column; a rolling one has edges, to the right and to the left.
    """

    outline: np.ndarray  # (n, 2) [m]
    right: np.ndarray  # (2,) corner 1
    left: np.ndarray  # corner 2
    centre: np.ndarray
    heights: np.ndarray  # of the nodes of the column [m]
    masses: np.ndarray  # heights of its masses [m]
    edges: tuple[Edge, Edge] | None = None

    @classmethod
    def of(cls, block: AnyBlock, model: AbstractEquation, edges: tuple[Edge, Edge] | None = None) -> "Body":
        """Return the body of a block of scalars, with `edges`, or those of the model, on which it rolls.

        Its parameters do not determine its whole shape. The body is the rectangle of its p, or the parallelogram about
        its centre of mass.
        """
        check_single(block=block, model=model)
        if isinstance(model, Rolling):
            edges = model.edge, model.other or model.edge
        body = cls._asymmetric(block) if isinstance(block, AsymmetricBlock) else cls._symmetric(block, model)
        return body if edges is None else body._rounded(edges)

    @classmethod
    def _symmetric(cls, block: Block | FlexibleBlock, model: AbstractEquation) -> "Body":
        alpha = float(block.alpha)
        radius = float(block.length) / 2 if isinstance(block, FlexibleBlock) else float(block.half_diagonal)
        if isinstance(block, Block) and block.beam is not None:  # the column, which alone has a higher frequency
            radius *= (1 + 2 * float(block.beam)) / (1 + 3 * float(block.beam))  # Makris & Vassiliou 2013
        b, h = radius * np.sin(alpha), radius * np.cos(alpha)
        side = np.linspace(0, 2 * h, 25)
        across = np.repeat(b, side.size)
        outline = np.concatenate([np.stack([across, side], 1), np.stack([-across, side[::-1]], 1)])
        corners = np.array([b, 0.0]), np.array([-b, 0.0])
        return cls(outline, *corners, np.array([0.0, h]), *_column(block, model, radius, h))

    @classmethod
    def _asymmetric(cls, block: AsymmetricBlock) -> "Body":
        alphas = np.array([float(block.alpha1), float(block.alpha2)])
        first = float(block.inertia_ratio) * GRAVITY / float(block.p1) ** 2
        radii = first * np.array([1.0, float(block.radius_ratio)])
        (b1, b2), (h1, h2) = radii * np.sin(alphas), radii * np.cos(alphas)
        centre = np.array([(b2 - b1) / 2, max(h1, h2)])
        right, left = centre + [b1, -h1], centre - [b2, h2]
        outline = np.stack([left, right, 2 * centre - left, 2 * centre - right])
        return cls(outline, right, left, centre, np.zeros(0), np.zeros(0))

    def _rounded(self, edges: tuple[Edge, Edge]) -> "Body":
        """Return the body with its edges, up to where they are upright or reach its top; its sides begin there."""
        top, parts = self.outline[:, 1].max(), []
        for way, corner, edge in zip((1, -1), (self.right, self.left), edges):
            out, up = map(np.asarray, edge.place(np.linspace(0, np.pi / 2, 60)))
            arc = corner + np.hypot(*(self.centre - corner)) * np.stack([way * out, up], 1)
            arc = arc[: max(int((arc[:, 1] <= top).sum()), 1)]
            above = 2 * self.centre - (self.left if way > 0 else self.right)
            parts += [arc, [above + [arc[-1, 0] - corner[0], 0.0]]]
        right, over_right, left, over_left = parts
        return self._replace(outline=np.concatenate([right, over_right, over_left, left[::-1]]), edges=edges)

    def placed(self, points: np.ndarray, rotation: float) -> np.ndarray:
        """Return where points [m] of the block at rest are at a rotation [rad]."""
        side, corner = (1, self.right) if rotation >= 0 else (-1, self.left)
        if self.edges is None:
            return turned(points, corner, rotation)
        edge, radius = self.edges[0 if side > 0 else 1], np.hypot(*(self.centre - corner))
        out, up = map(float, edge.place(abs(rotation)))
        touching = corner + radius * np.array([side * out, up])
        return turned(points, touching, rotation) + self.contact(rotation) - touching

    def contact(self, rotation: float) -> np.ndarray:
        """Return the point of contact with the ground at a rotation [rad]: a corner, or a point of a rolling edge."""
        side, corner = (1, self.right) if rotation >= 0 else (-1, self.left)
        if self.edges is None:
            return corner
        rolled = np.hypot(*(self.centre - corner)) * float(self.edges[0 if side > 0 else 1].length(abs(rotation)))
        return corner + np.array([side * rolled, 0.0])

    def lying(self, rotation: np.ndarray) -> np.ndarray:
        """Return the rotations [rad] to draw, limited to those at which a fallen block lies on its side.

        Block sides may lean, so that this is not always pi/2. Rotations of a rolling block are unchanged.
        """
        if self.edges is not None:
            return rotation
        for side, corner in ((1, self.right), (-1, self.left)):
            across, up = side * (self.outline[:, 0] - corner[0]), self.outline[:, 1] - corner[1]
            ahead = up > 1e-9 * self.size
            end, turn = np.arctan2(up[ahead], across[ahead]).min(), side * rotation
            rotation = side * np.where(turn > np.pi / 2 - 1e-9, end, np.minimum(turn, end))
        return rotation

    @property
    def size(self) -> float:
        """Largest distance from the origin [m]."""
        return float(max(np.hypot(*self.outline.T).max(), self.heights.max(initial=0.0)))

    def pose(self, rotation: float, bending: np.ndarray | None = None) -> Shapes:
        """Return the shapes at a rotation [rad] about a corner, or rolled, and with bending.

        `bending`, (nodes,) [m], is the displacement across the column.
        """
        outline, column = self.outline, np.stack([0 * self.heights, self.heights], 1)
        if bending is not None and self.heights.size:
            share = self.outline[:, 1] / self.outline[:, 1].max() * self.heights[-1]
            outline = outline + np.stack([np.interp(share, self.heights, bending), 0 * share], 1)
            column = column + np.stack([bending, 0 * bending], 1)
        column = turned(column, np.zeros(2), rotation)
        masses = np.stack([np.interp(self.masses, self.heights, x) for x in column.T], 1) if column.size else column
        return Shapes(self.placed(outline, rotation), column, masses, self.contact(rotation))


def _column(block: Block | FlexibleBlock, model: AbstractEquation, radius: float, h: float) -> tuple:
    """Return heights of the nodes and of the masses of the column that models a block."""
    if isinstance(block, FlexibleBlock):
        nodes = np.linspace(0, 2 * radius, block.masses)
        return nodes, nodes
    if not isinstance(model, Spring):
        return np.zeros(0), np.zeros(0)
    if model.kind == "mmSM":
        masses = np.zeros(0) if model.masses is None else np.linspace(0, 2 * radius, model.masses)
        return np.array([0.0, 2 * radius]), masses
    height = {"SM1": radius, "SM2": radius, "SM3": h}[model.kind]
    return np.array([0.0, height]), np.array([0.0 if model.kind == "SM2" else height])


def turned(points: np.ndarray, pivot: np.ndarray, rotation: float) -> np.ndarray:
    """Return points [m] turned about a pivot; a positive rotation is clockwise: the block leans to the right."""
    sine, cosine = np.sin(rotation), np.cos(rotation)
    return pivot + (points - pivot) @ np.array([[cosine, -sine], [sine, cosine]])
