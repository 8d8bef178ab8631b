"""The restitution of an impact that conserves angular momentum."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Inexact

from jaxrock._arguments.ranges import Range, acute
from jaxrock.compiler import elementwise

__all__ = ["housner"]


def __dir__() -> list[str]:
    return __all__


_inertia = Range("be finite, and at least 1", 1.0, jnp.inf, lambda x: (x >= 1) & (x < jnp.inf))  # 1: a point


@elementwise(alpha=acute, inertia=_inertia)
def housner(alpha: Inexact[ArrayLike, "..."], inertia: Inexact[ArrayLike, "..."] = 4 / 3) -> Float[Array, "..."]:
    """Angular velocity after an impact over that before it, if the block neither bounces nor slides.

    Let the block rotate with angular velocity w about its left corner O until its right corner O' meets the ground.
    The blow acts at O', so the angular momentum about O' is the same just before and just after. The centre of mass
    lies at (b, h) from O and at (-b, h) from O', and moves with velocity w x (b, h). Hence, with I the moment of
    inertia about the centre of mass and I + m (b^2 + h^2) = `inertia` m R^2 that about a corner,

        before:  [I + m (-b, h).(b, h)] w = [I + m (h^2 - b^2)] w = (`inertia` - 2 sin^2(alpha)) m R^2 w
        after:   `inertia` m R^2 w',

    and w'/w = 1 - 2 sin^2(alpha)/`inertia`. For a homogeneous rectangle, with `inertia` 4/3, it is
    1 - 1.5 sin^2(alpha), zero for a width of sqrt(2) heights.

    **Arguments:**

    - `alpha`: slenderness angle, tan(alpha) = b/h [rad], in (0, pi/2).
    - `inertia`: moment of inertia about a corner over m R^2 [-], at least 1; 4/3 for a homogeneous rectangle.

    **Returns:** the restitution; 0 where the momentum would throw the block back (there Housner's impact fails).

    **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 2.4.
    """
    return jnp.maximum(1 - 2 * jnp.sin(alpha) ** 2 / inertia, 0.0)
