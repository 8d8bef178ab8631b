"""The rigid block: its geometry and mass, reduced to slenderness, frequency parameter and restitution."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._arguments.parameters import Owner, parameter, set_parameters
from jaxrock._arguments.ranges import acute, rate, size, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import check_shapes, shown
from jaxrock._core.one_program import one_program
from jaxrock.blocks.restitution import (
    AbstractRestitution,
    Corners,
    Housner,
    Restitution,
    fitting_alpha,
    law_of,
    ratio_of_inertia,
)

GRAVITY = 9.81  # m/s^2, the value of the papers; `gravity=` changes it
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # [m]


class Block(Owner):
    """A free-standing symmetric rigid block.

    **Arguments:**

    - `alpha`: slenderness angle, tan(alpha) = half width / half height [rad], in (0, pi/2).
    - `p`: frequency parameter, sqrt(m g R / I) [rad/s], positive; sqrt(3 g / 4 R) for a rectangle.
    - `restitution`: angular velocity after an impact over that before it, in [0, 1]; or a law of restitution, such as
      `jaxrock.restitution.SpeedDependent(...)`. None means Housner's value 1 - 1.5 sin^2(alpha), which follows alpha
      under differentiation.

    All may be arrays of one shape, for use under `jax.vmap`.

    **Raises:** ValueError for a value outside its range; also when `restitution` is None and
    Housner's value would be negative (alpha above 0.955 rad: width above 1.41 heights).

    **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equations 2.3 and 2.4.
    """

    alpha: Inexact[Array, "..."] = parameter("rad", acute)
    p: Inexact[Array, "..."] = parameter("rad/s", rate)
    law: AbstractRestitution

    __repr__ = described

    @with_throw
    def __init__(self, alpha: ArrayLike, p: ArrayLike, restitution: Restitution | None = None, *, throw: bool = True):
        set_parameters(self, alpha=alpha, p=p)
        if isinstance(restitution, tuple):
            found = f"is {shown(restitution)}: one for each side is `jaxrock.restitution.PerSide`"
            raise ValueError(f"Argument `restitution` must be a number, an array or a law, but {found}.")
        self.law = law_of(restitution, Housner(), symmetric=True)
        self.alpha = fitting_alpha(self.law, self.alpha)

    @classmethod
    @with_throw
    def from_dimensions(
        cls,
        width: ArrayLike,
        height: ArrayLike,
        restitution: Restitution | None = None,
        gravity: ArrayLike = GRAVITY,
        *,
        throw: bool = True,
    ) -> "Block":
        """Build a homogeneous rectangular block from its full sizes.

        **Arguments:**

        - `width`: full width of the base in the plane of rocking [m], positive.
        - `height`: full height [m], positive.
        - `restitution`: as in `Block`.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Block` with tan(alpha) = width/height and p = sqrt(3 g / 4 R), R half the diagonal.

        **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 2.2.
        """
        width, height, gravity = size("width", width), size("height", height), size("gravity", gravity)
        check_shapes(width=width, height=height, gravity=gravity)
        alpha, half_diagonal = _of_rectangle(width, height)
        return cls.from_radius(alpha, half_diagonal, restitution, gravity=gravity)

    @classmethod
    @with_throw
    def from_radius(
        cls,
        alpha: ArrayLike,
        R: ArrayLike,
        restitution: Restitution | None = None,
        *,
        inertia_ratio: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
        throw: bool = True,
    ) -> "Block":
        """Build a block from its slenderness and the distance of its corners to the centre of mass.

        **Arguments:**

        - `alpha`: as in `Block`.
        - `R`: distance from either corner to the centre of mass [m], positive: half the diagonal of a rectangle.
        - `restitution`: as in `Block`; None follows the inertia ratio, too: 1 - 2 inertia_ratio sin^2(alpha).
        - `inertia_ratio`: m R^2/I, I the moment of inertia about a corner [-], in (0, 1]. None: 3/4, that of a
          homogeneous rectangle.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Block` with p = sqrt(inertia_ratio g / R), sqrt(3 g / 4 R) for a rectangle.

        **Raises:** ValueError for a value outside its range.

        **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 2.2.
        """
        radius, gravity = size("R", R), size("gravity", gravity)
        if inertia_ratio is None:
            return cls(alpha, _rate_of_rectangle(gravity, radius), restitution)
        ratio = ratio_of_inertia("inertia_ratio", inertia_ratio)
        return cls(alpha, jnp.sqrt(ratio * gravity / radius), law_of(restitution, Housner(ratio), symmetric=True))

    @property
    @one_program
    def restitution(self) -> Inexact[Array, "..."]:
        """Angular velocity after an impact over that before it.

        If it depends on the speed, this is the ratio of the gentlest impact; if on the side, of one that ends a stay on
        side 1.
        """
        return self.law.ratio(self.corners, jnp.zeros_like(self.p))

    @property
    def corners(self) -> Corners:
        """The arguments of the law of restitution for an impact."""
        return Corners(self.alpha, self.alpha, self.p)

    @property
    def half_diagonal(self) -> Inexact[Array, "..."]:
        """Distance from pivot to centre of mass of the rectangle with this p under 9.81 m/s^2 [m]."""
        return 3 * GRAVITY / (4 * self.p**2)


@one_program
def _of_rectangle(width: Inexact[Array, "..."], height: Inexact[Array, "..."]) -> tuple[Array, Array]:
    """Return the slenderness angle, and half the diagonal."""
    return jnp.arctan2(width, height), jnp.hypot(width, height) / 2


@one_program
def _rate_of_rectangle(gravity: Inexact[Array, "..."], radius: Inexact[Array, "..."]) -> Array:
    return jnp.sqrt(3 * gravity / (4 * radius))


class Side(eqx.Module):
    """One side of an asymmetric block, for a model: like a `Block`, but its restitution may exceed 1."""

    alpha: Inexact[Array, "..."]
    p: Inexact[Array, "..."]
    restitution: Inexact[Array, "..."]
