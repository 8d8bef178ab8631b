"""The flexible block: a rigid base on a spring of negative stiffness that carries an elastic column of masses."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock._arguments.parameters import Owner, leaves_of, parameter, set_parameters
from jaxrock._arguments.ranges import Range, below_one, checked, one_of, size, truth, whole, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.one_program import one_program
from jaxrock._core.types import Real
from jaxrock.blocks.cantilever import unit_column
from jaxrock.blocks.restitution import AbstractRestitution, Corners, Housner, Restitution, fits, fitting_width, law_of
from jaxrock.blocks.rigid import GRAVITY

_stiff = Range("be positive and finite, from 1e-9 to 1e30", 0.0, math.inf, lambda x: (x >= 1e-9) & (x <= 1e30))


class FlexibleBlock(Owner):
    """A rectangular elastic block that rocks: lumped masses on a cantilever whose base is a rocking spring (mmSM).

    The column of length 2R carries the ground's acceleration times cos(alpha). Its base turns against a moment that
    falls with its rotation; below M0 = m g R sin(alpha) the base is locked. When the rotation returns to zero, the
    velocities of all masses are multiplied by the restitution. With small rotations, "linear" or "plastic", and without
    P-Delta, every phase is linear and solved exactly. Otherwise the nonlinear terms are integrated beside the linear
    part.

    **Arguments:**

    - `width`, `height`: full sizes [m], positive. (The depth does not matter.)
    - `youngs_modulus`: [Pa], positive; so large that the column does not give way before its base. At most such that
      the column is 10^12 times as stiff (some 10^18 Pa for 1 m by 5 m: a rigid block to 12 digits). From 10^9 times on,
      an undamped column may vibrate too long for the search of its greatest bending: a `Status` then says so.
    - `density`: [kg/m^3], positive.
    - `damping_ratio`: of the column, in [0, 1) [-]; 0 for none.
    - `masses`: number of lumped masses, the one at the base included; 2 to 60. Six are within a few per cent of many.
    - `restitution`: velocities after an impact over those before it, in [0, 1], or a law of restitution, which gets the
      angular velocity of the base; None: Housner's, 1 - 1.5 sin^2(alpha).
    - `damping`: "stiffness": in proportion to the column's stiffness, with `damping_ratio` in its first clamped mode;
      "modal": `damping_ratio` in every clamped mode; "rayleigh": in proportion to stiffness and masses, with
      `damping_ratio` in the first two clamped modes. The masses' part also damps rigid rocking.
    - `impacts`: which returns of the base to zero count as impacts. "alternate": the first from either side, and later
      ones from that side that end a longer stay. A column that bounces on one edge is thus not slowed twice, and one
      that trembles as it uplifts is slowed when it comes down. "every": all of them.
    - `base`: moment of the base at the rotation x, less the moment of the straight column's weight. "sine":
      m g R sin(alpha - x), the block's own; "linear": M0 (1 - x/alpha), a constant negative stiffness; "plastic":
      M0 - m g R sin(x), or m g R x with small rotations, so that it balances at alpha, or at sin(alpha).
    - `rotations`: "small": sines of rotations are rotations, cosines 1. "finite": the exact rotations of the column's
      elements, so that its top moves by cos(alpha) times their sines, and the ground pushes with their cosines.
    - `p_delta`: whether the weight also acts on the bent column, and not only at its base.
    - `gravity`: [m/s^2], positive.

    Numbers may be arrays of one shape, for use under `jax.vmap`; `masses`, words and `p_delta` are one for all.

    **Raises:** ValueError for a value outside its range.

    **Source:** Diamantopoulos & Fragiadakis (2017), sections 3.4 and 6, with the laws of figure 3: of a stiff column
    equations 13 ("sine"), 14 ("linear") and 15 ("plastic"); Vassiliou, Mackie & Stojadinovic (2016).
    """

    width: Real = parameter("m", size)
    height: Real = parameter("m", size)
    youngs_modulus: Real = parameter("Pa", _stiff, symbol="E")
    density: Real = parameter("kg/m^3", size)
    damping_ratio: Real = parameter("-", below_one)
    law: AbstractRestitution
    gravity: Real = parameter("m/s^2", size)
    masses: int = eqx.field(static=True)
    damping: str = eqx.field(static=True)
    impacts: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    rotations: str = eqx.field(static=True)
    p_delta: bool = eqx.field(static=True)

    __repr__ = described

    @with_throw
    def __init__(
        self,
        width: ArrayLike,
        height: ArrayLike,
        youngs_modulus: ArrayLike,
        density: ArrayLike,
        damping_ratio: ArrayLike,
        masses: int = 6,
        *,
        restitution: Restitution | None = None,
        damping: str = "stiffness",
        impacts: str = "alternate",
        base: str = "linear",
        rotations: str = "small",
        p_delta: bool = False,
        gravity: ArrayLike = GRAVITY,
        throw: bool = True,
    ):
        self.damping = one_of("damping", damping, ("stiffness", "modal", "rayleigh"))
        self.impacts = one_of("impacts", impacts, ("alternate", "every"))
        self.base = one_of("base", base, ("sine", "linear", "plastic"))
        self.rotations = one_of("rotations", rotations, ("small", "finite"))
        self.p_delta = truth("p_delta", p_delta)
        least = 3 if damping == "rayleigh" else 2
        self.masses = whole("masses", masses, least, 60)
        set_parameters(self, width=width, height=height, youngs_modulus=youngs_modulus, density=density)
        set_parameters(self, damping_ratio=damping_ratio, gravity=gravity)
        self.law = law_of(restitution, Housner(), symmetric=True)
        self.width = fitting_width(self.law, self.width, self.height)
        for allowed, holds in _DEMANDS:
            now = holds(self)  # without errors: the modulus as the previous demand left it
            self.youngs_modulus = checked("youngs_modulus", self.youngs_modulus, allowed, lambda _, now=now: now)

    @property
    def alpha(self) -> Real:
        """Slenderness angle [rad]."""
        return jnp.arctan2(self.width, self.height)

    @property
    def length(self) -> Real:
        """Length of the column, 2R, from pivot to opposite corner [m]."""
        return jnp.hypot(self.width, self.height)

    @property
    def restitution(self) -> Real:
        """Velocities after an impact over those before it (D&F 2017, 21: Housner's).

        If they depend on the speed, this is the ratio of the gentlest impact; if on the side, of one that ends a stay
        on side 1.
        """
        return self.law.ratio(self.corners, jnp.zeros_like(self.alpha))

    @property
    def p(self) -> Real:
        """Frequency parameter of the rigid block of this size [rad/s]."""
        return jnp.sqrt(1.5 * self.gravity / self.length)

    @property
    def corners(self) -> Corners:
        """The arguments of the law of restitution for an impact."""
        return Corners(self.alpha, self.alpha, self.p)

    @property
    @one_program
    def first_period(self) -> Real:
        """First period of the clamped continuous column of the block's height [s].

        The masses stand on a column of the length 2R (`length`), whose periods (`frequencies`) are (2R/height)^(3/2)
        times as long.

        **Source:** Diamantopoulos & Fragiadakis (2017), equation 23: 12.38 sqrt(density/modulus) h/tan(alpha), h half
        the height, with 12.38 = 8 sqrt(3) pi/1.87510^2.
        """
        slowness = jnp.sqrt(self.density / self.youngs_modulus)
        return 8 * math.sqrt(3) * math.pi / 1.8751040687119611**2 * slowness * self.height**2 / (2 * self.width)

    @property
    @one_program
    def frequencies(self) -> Inexact[Array, "*batch modes"]:
        """Angular frequencies of the clamped column of masses [rad/s]."""
        return self._bending_rate[..., None] * unit_column(self.masses).frequencies

    @property
    def _bending_rate(self) -> Real:
        """sqrt(E I/(m L^3)), with section width^3/12 and mass density width height, both per depth [1/s]."""
        inertia = 12 * self.density * self.height * self.length
        return jnp.sqrt(self.youngs_modulus / inertia) * self.width / self.length

    @property
    def _column_stiffness(self) -> Inexact[Array, "*batch modes"]:
        """Stiffness against a rotation of the base, over m L^2, mode by mode [1/s^2]."""
        return (self.frequencies * unit_column(self.masses).rotation) ** 2

    @property
    def strength(self) -> Real:
        """Moment at which the base unlocks, over m L^2 [1/s^2]."""
        return self.gravity * jnp.sin(self.alpha) / (2 * self.length)

    @property
    def spring_rate(self) -> Real:
        """Negative stiffness of the base at its balance, over m L^2 [1/s^2]."""
        if self.base == "linear":
            return self.strength / self.alpha
        weight = self.gravity / (2 * self.length)
        return weight * jnp.cos(self.alpha) if self.base == "plastic" and self.rotations == "finite" else weight

    @property
    def balance(self) -> Real:
        """Rotation of the unstable equilibrium of a column that does not bend [rad]."""
        if self.base == "plastic" and self.rotations == "small":
            return jnp.sin(self.alpha)
        return self.alpha

    @property
    def is_linear(self) -> bool:
        """Return whether every phase of its motion is linear."""
        return self.base != "sine" and self.rotations == "small" and not self.p_delta

    @property
    @one_program
    def damping_rates(self) -> tuple[Real, Inexact[Array, "*batch modes"]]:
        """Decay rate a0 of the masses, and d of each clamped mode of the column: q'' + (a0 + d) q' + ... [1/s]."""
        frequencies = self.frequencies
        ratio, first = self.damping_ratio, frequencies[..., 0]
        if self.damping == "modal":
            return jnp.zeros_like(first), 2 * ratio[..., None] * frequencies
        if self.damping == "stiffness":
            return jnp.zeros_like(first), (2 * ratio / first)[..., None] * frequencies**2
        second = frequencies[..., 1]
        part = 2 * ratio / (first + second)
        return part * first * second, part[..., None] * frequencies**2


# Each demand on the stiffness of a column: words for the message, and a test of a block.
_DEMANDS: tuple[tuple[str, Callable], ...] = (
    (
        "make the column stiffer than its base is unstable",
        one_program(lambda block: jnp.sum(block._column_stiffness, -1) > block.spring_rate),
    ),
    (
        "make the column at most 1e12 times as stiff as its base is unstable: rounding shows above (a rigid block)",
        one_program(lambda block: jnp.sum(block._column_stiffness, -1) < 1e12 * block.spring_rate),
    ),
    (
        "make the column, held at its base, bear twice its own weight when `p_delta` is True",
        one_program(lambda block: not block.p_delta or _bears_itself(block)),
    ),
)


def _bears_itself(block: FlexibleBlock) -> Bool[Array, "..."]:
    buckling = unit_column(block.masses).buckling
    return buckling * block._bending_rate**2 > 2 * block.gravity / block.length


def is_possible(block: FlexibleBlock) -> Bool[Array, ""]:
    """Return whether the constructor would accept the block, whose numbers a step of an optimiser may have changed."""
    known = [leaf for leaf in leaves_of(block) if leaf.declared.axes is not None]
    held = [leaf.declared.range.holds(leaf.value) for leaf in known]
    held += [fits(block.law, block.width, block.height), *(holds(block) for _, holds in _DEMANDS)]
    return jnp.stack([jnp.all(each) for each in held]).all()
