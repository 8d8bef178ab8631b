"""The rigid block: its geometry and mass, reduced to slenderness, frequency parameter and restitution."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._arguments.parameters import Owner, parameter, set_parameters
from jaxrock._arguments.ranges import Range, acute, one_of, rate, size, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import check_shapes, is_traced, shown
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
_WAYS = {"right": 1, "left": -1}  # sides to which a wall opens
_mass_ratio = Range("be 0 or more, and at most 1e9", 0.0, np.inf, lambda x: (x >= 0) & (x <= 1e9))


class Block(Owner):
    """A free-standing symmetric rigid block.

    **Arguments:**

    - `alpha`: slenderness angle, tan(alpha) = half width / half height [rad], in (0, pi/2).
    - `p`: frequency parameter, sqrt(m g R / I) [rad/s], positive; sqrt(3 g / 4 R) for a rectangle.
    - `restitution`: angular velocity after an impact over that before it, in [0, 1]; or a law of restitution, such as
      `jaxrock.restitution.SpeedDependent(...)`. None means Housner's value 1 - 1.5 sin^2(alpha), which follows alpha
      under differentiation.
    - `opens`: "right" or "left" for a wall that rocks to one side only, as something stands behind it: towards positive
      or towards negative rotations. None: to both sides. Momentum does not determine how a wall rebounds, so it needs
      a `restitution`.

    The numbers may be arrays of one shape, for use under `jax.vmap`.

    **Raises:** ValueError for a value outside its range; also when `restitution` is None and Housner's value would be
    negative (alpha above 0.955 rad: width above 1.41 heights), or the wall opens to one side.

    **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equations 2.3 and 2.4. Walls of one side: Sorrentino,
    AlShawa & Decanini (2011).
    """

    alpha: Inexact[Array, "..."] = parameter("rad", acute)
    p: Inexact[Array, "..."] = parameter("rad/s", rate)
    law: AbstractRestitution
    # Of a frame: mass of the beam over that of all columns. None: one body, whose programs have no such number.
    beam: Inexact[Array, "..."] | None = parameter("-", _mass_ratio, is_free=False)
    opens: str | None = eqx.field(static=True, default=None)

    __repr__ = described

    @with_throw
    def __init__(
        self,
        alpha: ArrayLike,
        p: ArrayLike,
        restitution: Restitution | None = None,
        *,
        opens: str | None = None,
        throw: bool = True,
    ):
        self.opens = _checked_way(opens, restitution)
        set_parameters(self, alpha=alpha, p=p)
        if isinstance(restitution, tuple):
            found = f"is {shown(restitution)}: one for each side is `jaxrock.restitution.PerSide`"
            raise ValueError(f"Argument `restitution` must be a number, an array or a law, but {found}.")
        self.law, self.beam = law_of(restitution, Housner(), symmetric=True), None
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
        opens: str | None = None,
        throw: bool = True,
    ) -> "Block":
        """Build a homogeneous rectangular block from its full sizes.

        **Arguments:**

        - `width`: full width of the base in the plane of rocking [m], positive.
        - `height`: full height [m], positive.
        - `restitution`, `opens`: as in `Block`.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Block` with tan(alpha) = width/height and p = sqrt(3 g / 4 R), R half the diagonal.

        **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 2.2.
        """
        width, height, gravity = size("width", width), size("height", height), size("gravity", gravity)
        check_shapes(width=width, height=height, gravity=gravity)
        alpha, half_diagonal = _of_rectangle(width, height)
        return cls.from_radius(alpha, half_diagonal, restitution, gravity=gravity, opens=opens)

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
        opens: str | None = None,
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
        - `opens`: as in `Block`.

        **Returns:** a `Block` with p = sqrt(inertia_ratio g / R), sqrt(3 g / 4 R) for a rectangle.

        **Raises:** ValueError for a value outside its range.

        **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 2.2.
        """
        radius, gravity = size("R", R), size("gravity", gravity)
        if inertia_ratio is None:
            return cls(alpha, _rate_of_rectangle(gravity, radius), restitution, opens=opens)
        ratio, way = ratio_of_inertia("inertia_ratio", inertia_ratio), _checked_way(opens, restitution)
        if isinstance(restitution, Housner):
            _warn_of_two(ratio, 0.75 if restitution.inertia_ratio is None else restitution.inertia_ratio)
        law = law_of(restitution, Housner(ratio), symmetric=True)
        return cls(alpha, jnp.sqrt(ratio * gravity / radius), law, opens=way)

    @classmethod
    @with_throw
    def from_frame(
        cls,
        width: ArrayLike,
        height: ArrayLike,
        beam: ArrayLike,
        restitution: Restitution | None = None,
        gravity: ArrayLike = GRAVITY,
        *,
        throw: bool = True,
    ) -> "Block":
        """Build a frame: alike columns that stand freely under a rigid beam, which lies freely on them.

        The beam moves without turning, by twice the displacement of the columns' centres. So the frame moves as one
        block, of the columns' slenderness. It uplifts at tan(alpha), however heavy the beam. A rocking podium is such a
        frame: what stands rigidly on the beam adds to its mass. A deck that is pinned to the columns is
        `Block.from_masses`.

        **Arguments:**

        - `width`, `height`: full width and height of one column [m], positive.
        - `beam`: mass of the beam, with what it carries, over that of all columns [-], 0 or more.
        - `restitution`: as in `Block`; None: 1 - 2 k sin^2(alpha), k = 3 (1 + 4 beam)/(4 (1 + 3 beam)), which follows
          alpha and the beam.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Block` with p^2 = (3 g/4 R) (1 + 2 beam)/(1 + 3 beam), R half a column's diagonal. Without a
        beam it is that of `from_dimensions`.

        **Raises:** ValueError for a value outside its range.

        **Source:** Makris & Vassiliou (2013), who derive both formulas; derived again here from the bodies.
        """
        width, height, gravity = size("width", width), size("height", height), size("gravity", gravity)
        beam = _mass_ratio("beam", beam)
        check_shapes(width=width, height=height, beam=beam, gravity=gravity)
        alpha, half_diagonal = _of_rectangle(width, height)
        frequency, impact_ratio = _of_frame(_rate_of_rectangle(gravity, half_diagonal), beam)
        block = cls(alpha, frequency, law_of(restitution, Housner(impact_ratio), symmetric=True))
        return eqx.tree_at(lambda frame: frame.beam, block, beam, is_leaf=lambda x: x is None)

    @classmethod
    @with_throw
    def from_masses(
        cls,
        width: ArrayLike,
        height: ArrayLike,
        top: ArrayLike,
        restitution: Restitution | None = None,
        gravity: ArrayLike = GRAVITY,
        *,
        throw: bool = True,
    ) -> "Block":
        """Build a rectangular column that carries a mass, pinned at the centre of its top.

        The mass turns nothing, so it counts as a point. The same holds for columns that share a pinned deck.

        **Arguments:**

        - `width`, `height`: full width and height of the column [m], positive.
        - `top`: mass at the top over that of the column, or of all columns [-], 0 or more.
        - `restitution`: as in `Block`; None: 1 - 2 inertia_ratio sin^2(alpha), which follows the masses.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Block` with the slenderness, R and moment of inertia of both masses: tan(alpha) = (width/height)
        (1 + top)/(1 + 2 top).

        **Raises:** ValueError for a value outside its range.

        **Source:** derived here, as one rigid body (Housner 1963).
        """
        width, height, gravity = size("width", width), size("height", height), size("gravity", gravity)
        top = _mass_ratio("top", top)
        check_shapes(width=width, height=height, top=top, gravity=gravity)
        alpha, radius, ratio = _of_masses(width, height, top)
        return cls.from_radius(alpha, radius, restitution, inertia_ratio=ratio, gravity=gravity)

    @property
    @one_program
    def restitution(self) -> Inexact[Array, "..."]:
        """Angular velocity after an impact over that before it.

        If it depends on the speed, this is the ratio of the gentlest impact; if on the side, of one that ends a stay on
        side 1, or on the one side of a wall.
        """
        return self.law.ratio(self.corners, jnp.zeros_like(self.p))

    @property
    def corners(self) -> Corners:
        """The arguments of the law of restitution for an impact."""
        return Corners(self.alpha, self.alpha, self.p, side=self.only_side or 1)

    @property
    def only_side(self) -> int | None:
        """The side to which a wall opens, 1 or -1; None for a block that rocks to both sides."""
        return None if self.opens is None else _WAYS[self.opens]

    @property
    def base_ratio(self) -> Inexact[Array, "..."] | None:
        """Ratio of inertia in the sum of the forces under the columns of a frame [-]; None for one body.

        In place of m R^2/I: the centre of all masses moves (1 + 2 beam)/(1 + beam) times as far as those of columns.
        """
        return None if self.beam is None else 0.75 * (1 + 2 * self.beam) ** 2 / ((1 + self.beam) * (1 + 3 * self.beam))

    @property
    def half_diagonal(self) -> Inexact[Array, "..."]:
        """Distance from pivot to centre of mass of the rectangle with this p under 9.81 m/s^2 [m]."""
        return 3 * GRAVITY / (4 * self.p**2)


def _checked_way(opens: str | None, restitution: Restitution | None) -> str | None:
    """Return the side to which a wall opens, after a check that it has a restitution."""
    if opens is None:
        return None
    way = str(one_of("opens", opens, tuple(_WAYS)))  # of NumPy's strings Equinox warns
    if restitution is None:
        raise ValueError(
            "Argument `restitution` must be given for a wall that opens to one side: momentum does not determine how "
            "it rebounds from what stands behind it. Give a measured ratio in [0, 1], or a law of restitution."
        )
    return way


@one_program
def _of_rectangle(width: Inexact[Array, "..."], height: Inexact[Array, "..."]) -> tuple[Array, Array]:
    """Return the slenderness angle, and half the diagonal."""
    return jnp.arctan2(width, height), jnp.hypot(width, height) / 2


@one_program
def _rate_of_rectangle(gravity: Inexact[Array, "..."], radius: Inexact[Array, "..."]) -> Array:
    return jnp.sqrt(3 * gravity / (4 * radius))


@one_program
def _of_frame(frequency: Inexact[Array, "..."], beam: Inexact[Array, "..."]) -> tuple[Array, Array]:
    """Return the frequency parameter of a frame from that of its columns, and the inertia ratio of its impacts."""
    heavier = 1 + 3 * beam
    return frequency * jnp.sqrt((1 + 2 * beam) / heavier), 0.75 * (1 + 4 * beam) / heavier


@one_program
def _of_masses(
    width: Inexact[Array, "..."], height: Inexact[Array, "..."], top: Inexact[Array, "..."]
) -> tuple[Array, Array, Array]:
    """Return slenderness, radius and inertia ratio of a column with a point mass at the centre of its top."""
    centre = height / 2 * (1 + 2 * top) / (1 + top)
    square = (width / 2) ** 2 + centre**2
    inertia = (width**2 + height**2) / 3 + top * ((width / 2) ** 2 + height**2)  # about a corner, over column mass
    return jnp.arctan2(width / 2, centre), jnp.sqrt(square), (1 + top) * square / inertia


def _warn_of_two(ratio: Array, of_law: Array | float) -> None:
    if is_traced((ratio, of_law)) or np.allclose(ratio, of_law, rtol=1e-5, atol=0):
        return
    warnings.warn(
        f"The block has the inertia ratio {np.asarray(ratio)}, but that of its law of restitution is "
        f"{np.asarray(of_law)}. A rigid body has one ratio; a frame of columns under a beam is `Block.from_frame`.",
        stacklevel=5,
    )


class Side(eqx.Module):
    """One side of an asymmetric block, for a model: like a `Block`, but its restitution may exceed 1."""

    alpha: Inexact[Array, "..."]
    p: Inexact[Array, "..."]
    restitution: Inexact[Array, "..."]
