"""Vertical planes in which rocks are weak, and the plane that most of them share."""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from jaxrock._arguments.annotations import arguments, at_least, list_of
from jaxrock._arguments.ranges import not_negative, scalar
from jaxrock.blocks.rock import Rock


class WeakPlane(NamedTuple):
    """The vertical plane in which most rocks are weak.

    - `azimuth`: of that plane, in [0, pi) [rad].
    - `rocks`: (rocks,) which of them are weak in it.
    - `azimuths`: (azimuths,) of the planes that were tried [rad].
    - `slenderness`: (rocks, azimuths) in each, towards the weaker side [rad].
    """

    azimuth: float
    rocks: Bool[np.ndarray, " rocks"]
    azimuths: Float[np.ndarray, " azimuths"]
    slenderness: Float[np.ndarray, "rocks azimuths"]

    @property
    def weakest(self) -> Float[np.ndarray, " rocks"]:
        """Azimuth of the weakest plane of every rock [rad]."""
        return self.azimuths[self.slenderness.argmin(axis=1)]


@arguments
def shared_plane(
    rocks: Annotated[Sequence[Rock], list_of(Rock, "rocks")],
    excess: ArrayLike = 0.1,
    planes: Annotated[int, at_least(2, 3600)] = 180,
) -> WeakPlane:
    """Find the vertical plane in which most of some rocks are about as weak as in any.

    The direction of the strongest shaking is seldom known. Rocks of a site that all are weak in one plane constrain the
    shaking in that plane best, so a motion in two components is examined there first.

    **Arguments:**

    - `rocks`: `Rock`s whose meshes are turned alike.
    - `excess`: a rock is weak in a plane in which its slenderness, towards the weaker side, is at most 1 + `excess` of
      that in its weakest plane [-], 0 or more.
    - `planes`: number of planes that are tried, evenly over half a turn.

    **Returns:** a `WeakPlane`; of several that as many share, that of the least mean logarithm of slenderness.

    **Raises:** ValueError for arguments outside their ranges.
    """
    if not rocks:
        raise ValueError("Argument `rocks` must hold at least one rock, but is empty.")
    excess = float(scalar("excess", not_negative("excess", excess)))
    azimuths = np.linspace(0.0, np.pi, planes, endpoint=False)
    both = np.array([[rock.slenderness(azimuths), rock.slenderness(azimuths + np.pi)] for rock in rocks])
    least = both.min(axis=1)
    weak = least <= (1 + excess) * least.min(axis=1, keepdims=True)
    best = np.lexsort((np.log(least).mean(axis=0), -weak.sum(axis=0)))[0]
    return WeakPlane(float(azimuths[best]), weak[:, best], azimuths, least)
