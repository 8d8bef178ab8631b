"""Orientational analysis: which products of quantities have neither a dimension nor an orientation.

A quantity points along x, y or z, or has no orientation: a displacement or an acceleration points along its axis, an
angle in the x-y plane along z. Two equal orientations cancel, two unlike ones make the third. An equation must also be
consistent in orientations: mirrored scenes give mirrored answers. This constrains exponents of angles, which have no
dimension.

The analysis tells which groups may be used, not which the response depends on. A slender block's response, for example,
is unchanged if all angles and accelerations grow alike, which no orientation expresses.

**Source:** Siano (1985); Dimitrakopoulos & DeJong (2012), section 4, equations 4.4 to 4.9 and table 1.
"""

from collections.abc import Iterable
from numbers import Real
from typing import Any, NamedTuple

from jaxrock._arguments.ranges import one_of
from jaxrock._core.arrays import shown

__all__ = ["ORIENTATIONS", "QUANTITIES", "Quantity", "combined", "of_series", "power", "product"]


def __dir__() -> list[str]:
    return __all__


ORIENTATIONS = ("0", "x", "y", "z")


class Quantity(NamedTuple):
    """Dimension and orientation of a quantity.

    - `length`, `time`: exponents of its dimension. (No mass: it cancels in the equation of a rocking block.)
    - `orientation`: "x", "y" or "z"; "0" for none.
    """

    length: int = 0
    time: int = 0
    orientation: str = "0"

    @property
    def is_pure(self) -> bool:
        """True for a number without an orientation: a group that similar scenes can share."""
        return self == Quantity()


# Quantities of a block that rocks in the x-y plane, y upwards: D&D 4.7.
QUANTITIES = {
    "rotation": Quantity(orientation="z"),
    "alpha": Quantity(orientation="z"),
    "restitution": Quantity(),
    "p": Quantity(time=-1),
    "frequency": Quantity(time=-1),
    "time": Quantity(time=1),
    "velocity": Quantity(time=-1, orientation="z"),
    "acceleration": Quantity(length=1, time=-2, orientation="x"),
    "gravity": Quantity(length=1, time=-2, orientation="y"),
    "radius": Quantity(length=1),
}


def combined(first: str, second: str) -> str:
    """Return the orientation of a product of two quantities with these orientations.

    **Raises:** ValueError for anything but "0", "x", "y" and "z".

    **Source:** Dimitrakopoulos & DeJong (2012), equation 4.4 and table 1.
    """
    indices = (ORIENTATIONS.index(one_of("orientation", each, ORIENTATIONS)) for each in (first, second))
    one, other = indices
    return ORIENTATIONS[one ^ other]  # Klein's group of four: equal ones cancel, two unlike ones make the third


def power(orientation: str, exponent: int) -> str:
    """Return the orientation of a whole power: the quantity's own if the exponent is odd, "0" if it is even.

    **Raises:** ValueError for an exponent that is not whole: the orientation of the root of a square is undetermined.

    **Source:** Dimitrakopoulos & DeJong (2012), equation 4.5.
    """
    own = one_of("orientation", orientation, ORIENTATIONS)
    return own if _whole("exponent", exponent) % 2 else "0"


def of_series(orientation: str, exponents: Iterable[int]) -> str:
    """Return the orientation of a power series of a quantity that has terms with these exponents.

    **Returns:** that of its terms: "0" for the cosine of an angle, whose terms are even, the angle's own for its sine.

    **Raises:** ValueError where the terms differ, as those of an exponential: such a sum has no orientation.

    **Source:** Dimitrakopoulos & DeJong (2012), equation 4.6.
    """
    found = {power(orientation, exponent) for exponent in exponents}
    if len(found) != 1:
        raise ValueError(f"Argument `exponents` must be all even or all odd for the orientation {orientation!r}.")
    return found.pop()


def product(**exponents: int) -> Quantity:
    """Return dimension and orientation of a product of powers of the block's and the motion's quantities.

    **Arguments:**

    - `exponents`: whole numbers by the names of `QUANTITIES`: `product(acceleration=1, gravity=-1)` is that of a_g/g.

    **Returns:** a `Quantity`; where `is_pure`, the product is a dimensionless and orientationless group.

    **Raises:** ValueError for other names, and for exponents that are not whole numbers.

    **Source:** Dimitrakopoulos & DeJong (2012), equations 4.7 to 4.9.
    """
    length, time, orientation = 0, 0, "0"
    for name, exponent in exponents.items():
        one, exponent = QUANTITIES[one_of("name", name, tuple(QUANTITIES))], _whole(name, exponent)
        length, time = length + exponent * one.length, time + exponent * one.time
        orientation = combined(orientation, power(one.orientation, exponent))
    return Quantity(length, time, orientation)


def _whole(name: str, exponent: Any) -> int:
    if isinstance(exponent, Real) and not isinstance(exponent, bool) and float(exponent).is_integer():
        return round(float(exponent))
    raise ValueError(f"Argument `{name}` must be a whole number, but is {shown(exponent)}.")
