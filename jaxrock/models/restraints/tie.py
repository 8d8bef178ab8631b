"""A horizontal tie, which may yield or break."""

from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import not_negative, positive, size
from jaxrock._core.types import Real
from jaxrock.blocks.rigid import GRAVITY, Block
from jaxrock.models.restraints.damper import of_horizontal_damper
from jaxrock.models.restraints.link import Link
from jaxrock.models.restraints.restraint import AbstractRestraint, RestraintTerms
from jaxrock.models.terms import Terms


class Tie(AbstractRestraint):
    """A horizontal tie that holds the block at a height, in tension only.

    At an opening angle x it is height sin(x) R longer than at rest; its moment over m g R is tension height cos(x). A
    block that rocks to both sides has one tie for each side.

    - Elastic without `yields` and `breaks`: tension = stiffness height sin(x).
    - With `yields` it flows at that force, and stays longer: it is slack until the block takes up the slack again.
    - With `breaks` it breaks at that force, for good. A moment written as `jnp.where(x < limit, ...)` would heal.

    A vertical acceleration of the ground does not change the force. Both ties with a memory need the diffrax engine.

    **Arguments:**

    - `height`: over the pivot [R], positive.
    - `stiffness`: force over elongation [m g/R], positive.
    - `yields`: force at which the tie flows [m g], positive. None: never.
    - `breaks`: force at which the tie breaks [m g], positive. None: never.
    - `damping`: of a viscous damper beside the tie [m g/(R p)], 0 or more. None: none.

    `Tie.from_units` makes it from newtons, metres and kilograms.

    **Raises:** ValueError for a value outside its range, and for a tie that both yields and breaks.

    **Source:** derived here; Makris & Zhang (2001) for anchored blocks.
    """

    height: Real = parameter("R", positive)
    stiffness: Real = parameter("m g/R", positive)
    yields: Real | None = parameter("m g", positive)
    breaks: Real | None = parameter("m g", positive)
    damping: Real | None = parameter("m g/(R p)", not_negative)

    @arguments
    def __init__(
        self,
        height: ArrayLike,
        stiffness: ArrayLike,
        *,
        yields: ArrayLike | None = None,
        breaks: ArrayLike | None = None,
        damping: ArrayLike | None = None,
    ):
        if yields is not None and breaks is not None:
            raise ValueError("Arguments `yields` and `breaks` must not both be given.")
        self.yields = self.breaks = self.damping = None
        given = {"yields": yields, "breaks": breaks, "damping": damping}
        given = {name: value for name, value in given.items() if value is not None}
        set_parameters(self, height=height, stiffness=stiffness, **given)

    @classmethod
    @arguments
    def from_units(
        cls,
        height: ArrayLike,
        stiffness: ArrayLike,
        *,
        yields: ArrayLike | None = None,
        breaks: ArrayLike | None = None,
        damping: ArrayLike | None = None,
        mass: ArrayLike,
        R: ArrayLike,
        p: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> "Tie":
        """Build a tie from values in units.

        **Arguments:**

        - `height`: over the pivot [m], positive.
        - `stiffness`: force over elongation, as E A/length [N/m], positive.
        - `yields`, `breaks`: force at which it flows or breaks [N], positive. None: never.
        - `damping`: of a damper beside it [N s/m], 0 or more; needs `p`. None: none.
        - `mass`: of the block [kg], positive.
        - `R`: distance of its centre of mass from its corner [m], positive.
        - `p`: its frequency parameter [rad/s], positive.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** a `Tie`.

        **Raises:** ValueError for a value outside its range.
        """
        mass, R, gravity = size("mass", mass), size("R", R), size("gravity", gravity)
        weight = mass * gravity
        if damping is not None:
            if p is None:
                raise ValueError("Argument `p` must be given with `damping`.")
            damping = not_negative("damping", damping) * R * positive("p", p) / weight
        forces = {"yields": yields, "breaks": breaks}
        forces = {name: None if f is None else positive(name, f) / weight for name, f in forces.items()}
        stiff = positive("stiffness", stiffness) * R / weight
        return cls(positive("height", height) / R, stiff, **forces, damping=damping)

    def terms(self, block: Block) -> RestraintTerms:
        """Return the moment stiffness height^2 sin(x) cos(x) of an elastic tie, and that of a damper that lasts."""
        lasts, elastic = self.breaks is None, self.yields is None and self.breaks is None
        static = Terms(double_sine=self.stiffness * self.height**2 / 2) if elastic else None
        if not lasts or self.damping is None:
            return RestraintTerms(static)
        return RestraintTerms(static, of_horizontal_damper(self.damping, self.height))

    def link(self, block: Block) -> Link | None:
        """Return the link of a tie that yields or breaks."""
        if self.yields is not None:
            return Link(self.height, self.stiffness, self.yields, None, breaks=False)
        if self.breaks is not None:
            return Link(self.height, self.stiffness, self.breaks, self.damping, breaks=True)
        return None
