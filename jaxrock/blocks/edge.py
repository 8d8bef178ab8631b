"""Rounded edges, on which a block rolls as it opens, instead of turning about a corner."""

from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import checked, not_negative, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values
from jaxrock._core.one_program import one_program
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Real
from jaxrock.compiler.hints import select
from jaxrock.numerics.elementary import sine_cosine, sine_cosine_of_any, sine_lag
from jaxrock.numerics.lookup import count_up_to, stretch_from, take


class Edge(eqx.Module):
    """A rounded edge: the radius of curvature at the point where the block touches the ground, over R.

    At rest the block stands on the corner where the rounding begins, to which its slenderness and R belong. When it has
    opened by an angle, it has rolled on by the integral of the radius over that angle.

    **Arguments:**

    - `radius`: over the distance R of the centre of mass from that corner at rest [-], 0 or more (0: a sharp corner).
      A number: a circle. A list, (k,): the radius at the opening angles `angle`, on straight lines between them and
      constant beyond.
    - `angle`: (k,) opening angles [rad] of such a list, 0 or more and growing.

    **Raises:** ValueError for values outside their ranges, or that do not go together.
    """

    radius: Real = parameter("-", not_negative, axes=1)
    angle: Real | None = parameter("rad", not_negative, axes=1)

    __repr__ = described

    @with_throw
    def __init__(self, radius: Values, angle: Values | None = None):
        set_parameters(self, radius=radius)
        self.angle = None
        if angle is not None:
            set_parameters(self, angle=angle)
            angle = cast(Array, self.angle)
            if self.radius.ndim != 1 or self.radius.shape != angle.shape:
                shapes = f"{self.radius.shape} and {angle.shape}"
                raise ValueError(f"Arguments `radius` and `angle` must be lists of one length, but have {shapes}.")
            self.angle = checked("angle", angle, "grow from each to the next", _grows)
        elif self.radius.ndim != 0:
            raise ValueError(f"Argument `radius` must be one number without `angle`, but has {self.radius.shape}.")

    @one_program
    def at(self, opening: ArrayLike) -> Real:
        """Return the radius over R at the point of contact of a block that has opened by an angle."""
        return self._rounded(opening).radius

    @one_program
    def rise(self, opening: ArrayLike) -> Real:
        """Return the rise of the centre of mass over that on a sharp corner, over R: the integral of sin(x - y)
        radius(y).
        """
        return self._rounded(opening).rise

    @one_program
    def run(self, opening: ArrayLike) -> Real:
        """Return the distance of the point of contact beyond a sharp corner, over R: the integral of cos(x - y)
        radius(y).
        """
        return self._rounded(opening).run

    @one_program
    def length(self, opening: ArrayLike) -> Real:
        """Return the rolled distance along the ground, over R: the integral of the radius."""
        return self._rounded(opening).length

    @called_by_users
    def place(self, opening: ArrayLike) -> tuple[Real, Real]:
        """Return the place on the block that touches the ground when the block has opened by an angle, over R.

        It is measured from the corner outward and upward on the block at rest: the integrals of cos(y) radius(y) and
        sin(y) radius(y).
        """
        sine, cosine = sine_cosine(jnp.asarray(opening))
        run, rise = self.run(opening), self.rise(opening)
        return cosine * run + sine * rise, sine * run - cosine * rise

    def _rounded(self, opening: ArrayLike) -> "Rounded":
        told, opening = self.pieces().at, jnp.asarray(opening)
        for _ in opening.shape:
            told = jax.vmap(told)
        return told(opening)

    def pieces(self) -> "EdgePieces":
        """Return the edge in pieces on which its radius is linear in the opening angle."""
        none = jnp.zeros_like(self._first)
        if self.angle is None:
            return EdgePieces(None, Rounded(none, none, none, self.radius), none)
        start, radius = (
            jnp.concatenate([first[None], x]) for first, x in ((none, self.angle), (self._first, self.radius))
        )
        slope = jnp.diff(radius[1:]) / jnp.diff(self.angle)
        slope = jnp.concatenate([none[None], slope, none[None]])
        # The contribution of a piece is a constant vector on the block: it turns with the block.
        added = _added(jnp.diff(start), radius[:-1], slope[:-1])
        sine, cosine = sine_cosine_of_any(start)
        out = jnp.cumsum(cosine[1:] * added.run + sine[1:] * added.rise)
        up = jnp.cumsum(cosine[1:] * added.rise - sine[1:] * added.run)
        out, up, length = (jnp.concatenate([none[None], x]) for x in (out, up, jnp.cumsum(added.length)))
        before = Rounded(cosine * up + sine * out, cosine * out - sine * up, length, radius)
        return EdgePieces(start, before, slope)

    @property
    def _first(self) -> Real:
        return self.radius if self.angle is None else self.radius[0]

    def with_angles(self, angle: Real) -> "Edge":
        """Extend the list of angles of an edge without changing the edge; `angle` begins with its own."""
        if self.angle is None:
            return Edge(jnp.broadcast_to(self.radius, angle.shape), angle)
        return Edge(jnp.concatenate([self.radius, jnp.full(angle.size - self.angle.size, self.radius[-1])]), angle)


class Rounded(NamedTuple):
    """Contributions of an edge when the block has opened by an angle x, over R.

    - `rise`: rise of the centre of mass over that on a sharp corner, the integral of sin(x - y) radius(y).
    - `run`: distance of the point of contact beyond a sharp corner, the integral of cos(x - y) radius(y).
    - `length`: rolled distance; `radius`: at x.
    """

    rise: Real
    run: Real
    length: Real
    radius: Real


class EdgePieces(eqx.Module):
    """Pieces of an edge, on each of which the radius is linear in the opening angle.

    They hold the angles at which pieces start (None: a circle), the integrals up to there, and the slope of the radius.
    A single piece taken out of many has scalar numbers.
    """

    start: Real | None
    before: Rounded
    slope: Real

    @property
    def edge(self) -> Edge:
        """The whole edge."""
        return Edge(self.before.radius) if self.start is None else Edge(self.before.radius[1:], self.start[1:])

    def at(self, opening: Real) -> Rounded:
        """Return the contributions of the edge at one opening angle."""
        if self.start is None:
            return _added(opening, self.before.radius, self.slope)
        if self.start.ndim:
            return self._piece(count_up_to(self.start, opening) - 1).at(opening)
        before, beyond = self.before, opening - self.start
        sine, cosine = sine_cosine(beyond)
        added = _added(beyond, before.radius, self.slope)
        return Rounded(
            before.rise * cosine + before.run * sine + added.rise,
            before.run * cosine - before.rise * sine + added.run,
            before.length + added.length,
            added.radius,
        )

    def ahead(self, opening: Real, outward: Bool[Array, ""]) -> tuple["EdgePieces", Real]:
        """Return the piece on which a block rolls on from an opening angle, outward or inward, and the angle of its
        end.

        The angle is beyond pi/2 where no piece follows.
        """
        piece, angle, ends = stretch_from(cast(Array, self.start), opening, outward)
        return self._piece(piece), select(ends, angle, jnp.pi)

    def _piece(self, index: Int[Array, ""]) -> "EdgePieces":
        start, slope, *numbers = (
            take(x, jnp.maximum(index, 0)) for x in (cast(Array, self.start), self.slope, *self.before)
        )
        return EdgePieces(start, Rounded(*numbers), slope)


def _added(angle: Real, radius: Real, slope: Real) -> Rounded:
    """Return the contributions of a piece after a turn by an angle, from its initial radius and the slope of the
    radius.
    """
    lifted = 2 * sine_cosine(angle / 2)[0] ** 2  # 1 - cos(x)
    return Rounded(
        radius * lifted + slope * angle**3 * sine_lag(angle),  # x - sin(x)
        radius * sine_cosine(angle)[0] + slope * lifted,
        angle * (radius + slope * angle / 2),
        radius + slope * angle,
    )


def _grows(angle):
    arrays = np if isinstance(angle, np.ndarray) else jnp  # NumPy compiles nothing
    return angle > arrays.concatenate([-arrays.ones_like(angle[:1]), angle[:-1]])


def fitted_edge(opening: Float[np.ndarray, " n"], run: Float[np.ndarray, " n"], knots: int) -> Edge:
    """Fit an edge to the outward shift of the point of contact at every opening angle.

    **Arguments:**

    - `opening`: (n,) angles [rad], from 0 to where the block is in balance.
    - `run`: (n,) as `Edge.run` [-].
    - `knots`: number of angles, evenly from 0 to the last, at which the radius is given.

    **Returns:** an `Edge`, by least squares with radii of 0 or more (Lawson & Hanson 1974).
    """
    import scipy.optimize  # imported here: few calls need it, and the import takes long

    angle = np.linspace(0.0, opening[-1], knots)
    columns = [Edge(np.eye(knots)[k], angle).run(opening) for k in range(knots)]
    radius, _ = scipy.optimize.nnls(np.stack(columns, axis=1), run)
    return Edge(radius, angle)
