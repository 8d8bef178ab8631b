"""The interface of a restraint, and the sum of a model and its restraints."""

import abc
import functools
from typing import Any, NamedTuple

from jaxrock._arguments.parameters import Owner, check_declared
from jaxrock._arguments.repr import described
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block, Side
from jaxrock.models.coefficients import Coefficients
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.restraints.link import Link
from jaxrock.models.restraints.moments import RestrainedMoments
from jaxrock.models.rigid import Housner
from jaxrock.models.terms import Terms


class RestraintTerms(NamedTuple):
    """The moments of a restraint over m g R, as sums of terms; None for an absent one.

    - `static`: the moment against the opening, which depends on the opening angle alone.
    - `damping`: the moment over the velocity dx/d(p t).
    """

    static: Terms | None = None
    damping: Terms | None = None


class AbstractRestraint(Owner):
    """A restraint of a symmetric block: the base class of `Tendon`, `Tie` and `Damper`, and of your own.

    A model and restraints add up to a model: `rk.Housner() + rk.models.Tendon(stiffness=2.0)`. Its fields are
    parameters: derivatives by them exist. Lengths are over R, forces over m g.
    """

    __repr__ = described

    def __check_init__(self):
        check_declared(self)

    @abc.abstractmethod
    def terms(self, block: Block) -> RestraintTerms:
        """Return the moments of the restraint over m g R, as sums of terms.

        **Arguments:**

        - `block`: has `alpha` [rad] and `p` [rad/s], scalars.

        **Returns:** the terms: functions of the opening angle x, and of the velocity dx/d(p t).
        """

    @property
    def only_damps(self) -> bool:
        """Return whether the restraint has no moment on a block that stands still."""
        return False

    def link(self, block: Block) -> Link | None:
        """Return a link with a memory, which acts besides the terms; None for a restraint without memory."""
        return None

    def restrains(self, model: AbstractEquation) -> "Restrained":
        """Return the sum of a model and this restraint."""
        if isinstance(model, Restrained):
            return Restrained(model.model, (*model.restraints, self))
        return Restrained(model, (self,))


class Restrained(AbstractEquation):
    """The sum of a model and restraints, as `model + restraint` makes it.

    **Arguments:**

    - `model`: `Housner()`; with dampers alone, any model whose moments are `Coefficients`.
    - `restraints`: tuple of restraints.

    **Raises:** ValueError for a model that takes no such restraint, and for two ties that break.
    """

    model: AbstractEquation
    restraints: tuple[AbstractRestraint, ...]

    def __repr__(self) -> str:
        return " + ".join(map(repr, (self.model, *self.restraints)))

    def parameter_path(self, path: tuple[str, ...]) -> tuple[str, ...]:
        """Return a short name of a parameter: the class of its restraint, numbered where there are several of it."""
        first, *rest = path
        if first != "restraints":
            return tuple(rest)
        place, kinds = int(rest[0]), [type(each).__name__.lower() for each in self.restraints]
        kind = kinds[place]
        number = kinds[: place + 1].count(kind)
        return (kind if kinds.count(kind) == 1 else f"{kind}{number}", *rest[1:])

    def __check_init__(self):
        if not self.model.is_series:
            raise ValueError(
                f"Argument `model` must have moments with a Taylor series to be restrained, but is {self.model!r}. Add "
                "the moments of restraints to the functions of an `Equation`."
            )
        if type(self.model) is not Housner and not all(restraint.only_damps for restraint in self.restraints):
            raise ValueError(
                f"Argument `model` must be `Housner()` for restraints that are no dampers, but is {self.model!r}."
            )
        if sum(getattr(restraint, "breaks", None) is not None for restraint in self.restraints) > 1:
            raise ValueError("Argument `restraints` must hold at most one tie that breaks.")

    def moments(self, block: Block | Side) -> RestrainedMoments:
        """Return the moments of the model and of all restraints."""
        if not isinstance(block, Block):
            raise ValueError("Argument `block` must be a `Block` for a model with restraints.")
        free: Any = self.model.moments(block)
        if not isinstance(free, Coefficients):
            raise ValueError(f"The moments of {self.model!r} must be `Coefficients` to be restrained.")
        told = [restraint.terms(block) for restraint in self.restraints]
        links = [restraint.link(block) for restraint in self.restraints]
        return RestrainedMoments.of(
            free,
            _sum([each.static for each in told]),
            _sum([each.damping for each in told]),
            tuple(link for link in links if link is not None),
        )

    def moments_of_sides(self, block: AsymmetricBlock):
        """Refuse: what a restraint does on corners of unequal height is not defined."""
        raise ValueError("Argument `block` must be a symmetric `Block` for a model with restraints.")

    @property
    def falls_flat(self) -> bool:
        """Return whether the model falls flat."""
        return self.model.falls_flat

    @property
    def is_series(self) -> bool:
        """Return whether no restraint has a memory."""
        return not any(_remembers(restraint) for restraint in self.restraints)

    @property
    def feels_weight(self) -> bool:
        """Return whether the model feels the weight; restraints do not."""
        return self.model.feels_weight


def _remembers(restraint: AbstractRestraint) -> bool:
    return any(getattr(restraint, name, None) is not None for name in ("yields", "breaks"))


def _sum(terms: list[Terms | None]) -> Terms | None:
    known = [each for each in terms if each is not None]
    return functools.reduce(Terms.plus, known) if known else None
