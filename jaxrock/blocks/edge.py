"""Rounded edges: what a block rolls on as it opens, in place of a corner about which it turns."""

from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Inexact

from jaxrock._checks import Values, checked, not_negative, one_program, with_throw
from jaxrock._described import described
from jaxrock._parameters import parameter, set_parameters
from jaxrock.numerics.elementary import sine_cosine, sine_lag

Real = Inexact[Array, "..."]


class Edge(eqx.Module):
    """An edge that is rounded: the radius of curvature at the point where the block touches the ground, over R.

    At rest the block stands on the corner where the rounding begins, to which its slenderness and R belong; when it
    has opened by an angle, it has rolled on by the integral of the radius over that angle.

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
        """Radius over R where a block touches the ground that has opened by an angle."""
        if self.angle is None:
            return jnp.asarray(self.radius)
        return self._first + jnp.sum(self._bends * self._beyond(opening), -1)

    @one_program
    def rise(self, opening: ArrayLike) -> Real:
        """By how much the centre of mass is higher than over a sharp corner, over R: the integral of
        sin(x - y) radius(y)."""
        half = sine_cosine(jnp.asarray(opening) / 2)[0]
        found = self._first * 2 * half**2
        if self.angle is None:
            return found
        beyond = self._beyond(opening)
        return found + jnp.sum(self._bends * beyond**3 * sine_lag(beyond), -1)  # x - sin(x)

    @one_program
    def run(self, opening: ArrayLike) -> Real:
        """By how much the point of contact is farther out than a sharp corner, over R: the integral of
        cos(x - y) radius(y)."""
        found = self._first * sine_cosine(jnp.asarray(opening))[0]
        if self.angle is None:
            return found
        return found + jnp.sum(self._bends * 2 * sine_cosine(self._beyond(opening) / 2)[0] ** 2, -1)

    def length(self, opening: ArrayLike) -> Real:
        """How far it has rolled along the ground, over R: the integral of the radius."""
        found = self._first * jnp.asarray(opening)
        return found if self.angle is None else found + jnp.sum(self._bends * self._beyond(opening) ** 2, -1) / 2

    def place(self, opening: ArrayLike) -> tuple[Real, Real]:
        """Where the edge touches the ground when the block has opened by an angle, from the corner outward and upward
        on the block as it stands, over R: the integrals of cos(y) radius(y) and sin(y) radius(y)."""
        sine, cosine = sine_cosine(jnp.asarray(opening))
        run, rise = self.run(opening), self.rise(opening)
        return cosine * run + sine * rise, sine * run - cosine * rise

    @property
    def _first(self) -> Real:
        return self.radius if self.angle is None else self.radius[0]

    @property
    def _bends(self) -> Real:
        """By how much the slope of the radius changes at every angle."""
        none = jnp.zeros_like(self.radius[:1])
        slopes = jnp.concatenate([none, jnp.diff(self.radius) / jnp.diff(self._angles), none])
        return jnp.diff(slopes)

    def _beyond(self, opening: ArrayLike) -> Real:
        return jnp.maximum(jnp.asarray(opening)[..., None] - self._angles, 0.0)

    @property
    def _angles(self) -> Real:
        return cast(Array, self.angle)  # asked where there are some

    def with_angles(self, angle: Real) -> "Edge":
        """The same edge by a longer list of angles, whose first are its own."""
        if self.angle is None:
            return Edge(jnp.broadcast_to(self.radius, angle.shape), angle)
        return Edge(jnp.concatenate([self.radius, jnp.full(angle.size - self.angle.size, self.radius[-1])]), angle)


def _grows(angle):
    arrays = np if isinstance(angle, np.ndarray) else jnp  # NumPy compiles nothing
    return angle > arrays.concatenate([-arrays.ones_like(angle[:1]), angle[:-1]])


def fitted_edge(opening: Float[np.ndarray, " n"], run: Float[np.ndarray, " n"], knots: int) -> Edge:
    """The edge that is fitted best to how far out a block touches the ground at every opening angle.

    **Arguments:**

    - `opening`: (n,) angles [rad], from 0 to where the block is in balance.
    - `run`: (n,) as `Edge.run` [-].
    - `knots`: at how many angles, evenly from 0 to the last, the radius is told.

    **Returns:** an `Edge`, by least squares with radii of 0 or more (Lawson & Hanson 1974).
    """
    import scipy.optimize  # few need it, and it takes long

    angle = np.linspace(0.0, opening[-1], knots)
    columns = [Edge(np.eye(knots)[k], angle).run(opening) for k in range(knots)]
    radius, _ = scipy.optimize.nnls(np.stack(columns, axis=1), run)
    return Edge(radius, angle)
