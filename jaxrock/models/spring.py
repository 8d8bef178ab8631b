"""Rigid columns on a rotational spring."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._arguments.ranges import checked, one_of, whole
from jaxrock.blocks.rigid import Block, Side
from jaxrock.models.coefficients import Coefficients
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.terms import Terms
from jaxrock.numerics.elementary import sine_cosine


class Spring(AbstractEquation):
    """A rigid column on a rotational spring without play: the spring models of a rigid block.

    **Arguments:**

    - `kind`: `"SM1"` (the mass at a distance R above the spring), `"SM2"` (the mass at the pivot, shaken by a moment)
      or `"SM3"` (the mass at the height R cos(alpha) above the spring), all with the block's moment of inertia; or
      `"mmSM"` (a rigid column of length 2R that carries many masses).
    - `law`: moment of the spring over m g R at the opening angle x: `"sine"`: sin(alpha - x), the block's own;
      `"linear"`: sin(alpha) (1 - x/alpha), a constant negative stiffness; `"plastic"`: sin(alpha), and the weight of
      the leaning column pulls by sin(x) (SM1, mmSM) or cos(alpha) sin(x) (SM2, SM3).
    - `masses`: of mmSM: their number, 2 or more, at equal distances from the base to the top. Each carries the part of
      the column next to it, those at the ends half as much. Their mean height is R. Their moment of inertia is
      1 + 1/(2 (masses - 1)^2) times the block's. None: a mass that is spread along the column, as printed.

    All have the overturning arm cos(alpha) cos(x), uplift at tan(alpha), and lie flat at pi/2. So SM1, SM2 and SM3
    differ by the law "plastic" alone, and mmSM is a slower SM1. They balance at x = alpha. SM2 and SM3 with the law
    "plastic" balance where sin(x) = tan(alpha): there alpha must be below pi/4, for a stouter block never overturns on
    it.

    Equation 9 lets the weight lean in SM2 although its mass is at the pivot; it is taken as printed. Codes that shake
    SM2 by a moment, or use linear geometry, have the arm cos(alpha): `Equation` does that.

    Under vertical motion a spring is not a block: its moment does not change with the weight. That raises ValueError.

    **Raises:** ValueError for other words, and for `masses` that are fewer than 2 or of another kind than mmSM; at use,
    for a block of alpha >= pi/4 where that is not allowed.

    **Source:** Diamantopoulos & Fragiadakis (2017), equations 4-6 (SM1), 7-9 (SM2), 10-12 (SM3), 13-15 (mmSM).
    """

    kind: str = eqx.field(static=True)
    law: str = eqx.field(static=True)
    masses: int | None = eqx.field(static=True)

    def __init__(self, kind: str = "SM1", law: str = "linear", masses: int | None = None):
        self.kind = one_of("kind", kind, ("SM1", "SM2", "SM3", "mmSM"))
        self.law = one_of("law", law, ("sine", "linear", "plastic"))
        if masses is not None and kind != "mmSM":
            raise ValueError(f"Argument `masses` must be None for {kind!r}, which has one mass, but is {masses!r}.")
        self.masses = None if masses is None else whole("masses", masses, 2)

    def moments(self, block: Block | Side) -> Coefficients:
        """Return the moments of the spring and of the weight, where the law separates these; arm cos(alpha) cos(x)."""
        found = self._moments(block)
        if self.masses is None:
            return found
        return found.times(1 / (1 + 1 / (2 * (self.masses - 1) ** 2)))  # moments of inertia, block over column

    def _moments(self, block: Block | Side) -> Coefficients:
        """Return the moments over the block's moment of inertia."""
        alpha, leans_by_height = self.balanced("block.alpha", block.alpha), self.kind in ("SM2", "SM3")
        sine, cosine = sine_cosine(alpha)
        arm = Terms(cosine=cosine)
        if self.law == "sine":
            return Coefficients(Terms(sine=-cosine, cosine=sine), arm)  # D&F 2017, 4, 7, 10, 13
        if self.law == "linear":
            return Coefficients(Terms(constant=sine, line=-sine / alpha), arm)  # D&F 2017, 5, 8, 11, 14
        weight = cosine if leans_by_height else jnp.ones_like(alpha)
        return Coefficients(Terms(constant=sine, sine=-weight), arm)  # D&F 2017, 6, 15; 9, 12

    def balanced(self, name: str, alpha: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        """Check a slenderness angle where the spring balances only some; an earlier check has rejected NaN."""
        if self.law != "plastic" or self.kind not in ("SM2", "SM3"):
            return alpha
        message = f"be below pi/4 in Spring({self.kind!r}, law='plastic'), which never overturns above"
        return checked(name, alpha, message, lambda angle: ~(angle >= jnp.pi / 4))

    @property
    def feels_weight(self) -> bool:
        """Return False: the moment of a spring does not change with the weight."""
        return False
