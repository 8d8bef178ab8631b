"""A tendon along the centre line."""

from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import not_negative, size
from jaxrock._core.types import Real
from jaxrock.blocks.rigid import GRAVITY, Block
from jaxrock.models.restraints.restraint import AbstractRestraint, RestraintTerms
from jaxrock.models.terms import Terms
from jaxrock.numerics.elementary import sine_cosine


class Tendon(AbstractRestraint):
    """An elastic tendon from the ground through the middle of the base, along the centre line, to the block.

    At an opening angle x it is 2 sin(alpha) sin(x/2) R longer than at rest, and its moment over m g R is

        [prestress + stiffness 2 sin(alpha) sin(x/2)] sin(alpha) cos(x/2).

    The block then uplifts at tan(alpha) (1 + prestress). A tendon stiffer than cos(alpha)/sin^2(alpha) makes the
    restoring moment rise. A vertical acceleration of the ground does not change the force.

    **Arguments:**

    - `stiffness`: force over elongation [m g/R], 0 or more.
    - `prestress`: force at rest [m g], 0 or more. None: no prestress.

    `Tendon.from_units` makes it from newtons, metres and kilograms, also for a frame.

    **Raises:** ValueError for a value outside its range.

    **Source:** derived here; Vassiliou & Makris (2015) for the frame.
    """

    stiffness: Real = parameter("m g/R", not_negative)
    prestress: Real | None = parameter("m g", not_negative)

    @arguments
    def __init__(self, stiffness: ArrayLike, prestress: ArrayLike | None = None):
        self.prestress = None
        given = {} if prestress is None else {"prestress": prestress}
        set_parameters(self, stiffness=stiffness, **given)

    @classmethod
    @arguments
    def from_units(
        cls,
        stiffness: ArrayLike,
        prestress: ArrayLike | None = None,
        *,
        mass: ArrayLike,
        R: ArrayLike,
        beam: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> "Tendon":
        """Build a tendon from values in units.

        **Arguments:**

        - `stiffness`: axial stiffness, as E A/length [N/m], 0 or more.
        - `prestress`: force at rest [N], 0 or more. None: no prestress.
        - `mass`: of the block, or of one column of a frame [kg], positive.
        - `R`: distance of the centre of mass of the block or column from its corner [m], positive.
        - `beam`: mass of the beam over that of all columns [-], 0 or more, of a frame whose columns have a tendon each
          through both joints. None: a block.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Tendon`. In a frame the elongation is twice that of a block, and the weight is that of the
        columns and twice the beam.

        **Raises:** ValueError for a value outside its range.
        """
        stiffness, mass, R, gravity = (
            not_negative("stiffness", stiffness),
            size("mass", mass),
            size("R", R),
            size("gravity", gravity),
        )
        weight, longer = mass * gravity, 1
        if beam is not None:
            weight, longer = weight * (1 + 2 * not_negative("beam", beam)), 2
        force = None if prestress is None else longer * not_negative("prestress", prestress) / weight
        return cls(longer**2 * stiffness * R / weight, force)

    def terms(self, block: Block) -> RestraintTerms:
        """Return the moment (P + K 2 sin(alpha) sin(x/2)) sin(alpha) cos(x/2), its product of sines as one sine."""
        sine = sine_cosine(block.alpha)[0]
        tension = None if self.prestress is None else self.prestress * sine
        return RestraintTerms(Terms(sine=self.stiffness * sine**2, half_cosine=tension))
