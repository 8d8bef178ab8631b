"""Static resistance of a rigid block: force, energy, and the initial velocity and free rocking that follow from them.

Also the static resistance of the spring models that replace the block, and their overturning moment.
"""

from typing import Any

import jax.numpy as jnp

from jaxrock._arguments.ranges import acute, below_one, checked, not_negative, one_of, share
from jaxrock._core.types import Floats, RealLike
from jaxrock.compiler import elementwise

__all__ = [
    "amplitude_after", "energy", "force", "overturning_moment_ratio", "period", "spring_force",
    "toppling_velocity",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


def _leaning(name, value):
    return checked(name, value, "be in [0, pi/2)", lambda x: (x >= 0) & (x < jnp.pi / 2))


def _up_to_flat(name, value):
    return checked(name, value, "be in [0, pi/2]", lambda x: (x >= 0) & (x <= jnp.pi / 2))


_elementwise = elementwise(
    alpha=acute, rotation=_up_to_flat, amplitude=below_one, restitution=share, impacts=not_negative
)
_of_springs = elementwise(alpha=acute, rotation=_leaning)


@_elementwise
def force(rotation: RealLike, alpha: RealLike) -> Floats:
    """Horizontal force at the centre of mass, over the weight, that holds the block at a rotation.

    At rotation 0 it is the acceleration in g at which the block uplifts; it is zero at alpha, where the block
    stands in balance on its corner.

    **Arguments:**

    - `rotation`: [rad], in [0, pi/2], where the block lies flat. `alpha`: slenderness angle [rad], in (0, pi/2).

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Diamantopoulos & Fragiadakis (2017), equation 16: tan(alpha - rotation).
    """
    return jnp.tan(alpha - rotation)


@_of_springs
def _force_sine(rotation, alpha):
    return jnp.tan(alpha) - jnp.tan(rotation)  # D&F 2017, 17


@_of_springs
def _force_linear(rotation, alpha):
    return jnp.tan(alpha) * (1 - rotation / alpha) / jnp.cos(rotation)  # as 17, with the moment of 5, 8, 11, 14


@_of_springs
def _force_plastic_diagonal(rotation, alpha):
    return jnp.tan(alpha) / jnp.cos(rotation) - jnp.tan(rotation) / jnp.cos(alpha)  # D&F 2017, 18


@_of_springs
def _force_plastic_height(rotation, alpha):
    return jnp.tan(alpha) / jnp.cos(rotation) - jnp.tan(rotation)  # D&F 2017, 19


def spring_force(rotation: RealLike, alpha: RealLike, kind: str = "SM1", law: str = "linear") -> Floats:
    """Horizontal force at the mass, over the weight, that holds a spring model at a rotation: its pushover curve.

    **Arguments:**

    - `rotation`: [rad], in [0, pi/2). `alpha`: slenderness angle [rad], in (0, pi/2).
    - `kind`, `law`: as in `jaxrock.Spring`. The mass of "SM2" is at the pivot: its value is the moment over the weight
      and over the arm R cos(alpha) cos(rotation) of the others.

    **Returns:** the force; tan(alpha) at rotation 0 in all of them, as `force`.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Diamantopoulos & Fragiadakis (2017), equations 17 (law "sine"), 18 ("plastic", SM1 and mmSM) and 19
    ("plastic", SM3); for the law "linear" the moment of equations 5, 8, 11 and 14 over the same arm.
    """
    one_of("kind", kind, ("SM1", "SM2", "SM3", "mmSM"))
    one_of("law", law, ("sine", "linear", "plastic"))
    plastic = _force_plastic_diagonal if kind in ("SM1", "mmSM") else _force_plastic_height
    return {"sine": _force_sine, "linear": _force_linear, "plastic": plastic}[law](rotation, alpha)


@_of_springs
def overturning_moment_ratio(rotation: RealLike, alpha: RealLike) -> Floats:
    """Overturning moment of the spring models over that of the block, under one ground acceleration.

    **Arguments:**

    - `rotation`: [rad], in [0, pi/2). `alpha`: slenderness angle [rad], in (0, pi/2).

    **Returns:** cos(alpha) cos(rotation)/cos(alpha - rotation) = 1/(1 + tan(alpha) tan(rotation)): one at rotation 0,
    less beyond.

    **Source:** Diamantopoulos & Fragiadakis (2017), figure 15.
    """
    return 1 / (1 + jnp.tan(alpha) * jnp.tan(rotation))


@_elementwise
def energy(rotation: RealLike, alpha: RealLike) -> Floats:
    """Work over m g R that brings the block from rest to a rotation.

    **Arguments:**

    - `rotation`: [rad], in [0, pi/2], where the block lies flat. `alpha`: slenderness angle [rad], in (0, pi/2).

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 4.12 corrected:
    cos(alpha - rotation) - cos(alpha).
    """
    # A product in place of the difference: small rotations of slender blocks do not cancel.
    return 2 * jnp.sin(rotation / 2) * jnp.sin(alpha - rotation / 2)


@_elementwise
def toppling_velocity(alpha: RealLike) -> Floats:
    """Angular velocity over p with which a block must leave the ground to reach its balance: 2 sin(alpha/2).

    **Source:** Housner (1963), the energy that overturns.
    """
    return 2 * jnp.sin(alpha / 2)


@_elementwise
def period(amplitude: RealLike) -> Floats:
    """Period of the free rocking of a slender block, times p.

    **Arguments:**

    - `amplitude`: largest rotation over alpha, in [0, 1).

    **Returns:** 4 arccosh(1/(1 - amplitude)): it goes to 0 with the amplitude and to infinity towards alpha.

    **Source:** Housner (1963), equation 7.
    """
    return 4 * jnp.log1p((amplitude + jnp.sqrt(amplitude * (2 - amplitude))) / (1 - amplitude))


@_elementwise
def amplitude_after(impacts: RealLike, amplitude: RealLike, restitution: RealLike) -> Floats:
    """Largest rotation over alpha of a slender block after a number of impacts in free rocking.

    **Arguments:**

    - `impacts`: how many, 0 or more. `amplitude`: largest rotation over alpha before, in [0, 1).
    - `restitution`: angular velocity after over before an impact, in [0, 1].

    **Source:** Housner (1963), equation 10: each impact multiplies the energy by restitution^2.
    """
    kept = jnp.where(impacts == 0, 1.0, restitution)  # 0^0 would have no derivative
    part: Any = kept ** (2 * impacts)  # of the energy
    missing = (1 - part) + part * (1 - amplitude) ** 2  # energy to balance, without cancellation
    return part * amplitude * (2 - amplitude) / (1 + jnp.sqrt(missing))
