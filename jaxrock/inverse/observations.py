"""Observations of rocks: which stand, which toppled, how far one rocked, and how accurately each of them is known."""

from collections.abc import Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._arguments.annotations import arguments, list_of
from jaxrock._arguments.ranges import checked, not_negative
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values, as_real, if_traced, is_traced, of_each, shown, to_device
from jaxrock._core.did_you_mean import did_you_mean
from jaxrock._core.label import Label
from jaxrock._core.one_program import one_program
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Real
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import AngularMomentum, Corners, Housner
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks

SEEN = ("survived", "toppled", "rotation")
_ALSO = {  # synonyms that are accepted
    "survived": ("stood", "stands", "standing", "stable", "survives", "upright"),
    "toppled": ("fell", "fallen", "falls", "overturned", "overturns", "topples"),
    "rotation": ("rocked", "measured"),
}
CALLED = {word: name for name in SEEN for word in (name, *_ALSO[name])}
SEEN_TOPPLED, SEEN_ROTATION = 1, 2  # places in SEEN
Rocks = Inexact[Array, " rocks"]
Flags = Bool[Array, "..."]


class OtherSide(eqx.Module):
    """Side 2 of asymmetric rocks relative to side 1, and the orientation of the rocks; (..., rocks) each.

    - `alpha_ratio`: alpha2/alpha1; `radius_ratio`: R2/R1.
    - `inertia_ratio`: m R1^2/I1.
    - `restitution_ratio`: restitution of the impact that ends the stay on side 1, over that on side 2.
    - `ways`: (ways, rocks) signs of the motion that each rock may have felt, all equally likely: one row, or two if
      the orientation of some rocks is unknown.
    """

    __repr__ = described

    alpha_ratio: Rocks
    radius_ratio: Rocks
    inertia_ratio: Rocks
    restitution_ratio: Rocks
    ways: Inexact[Array, "ways rocks"]


class Observations(eqx.Module):
    """Rocks at one site, and the outcome of each in one shaking.

    The constructor takes symmetric rocks; `Observations.asymmetric` takes rocks whose sides differ.

    **Arguments:**

    - `alpha`: (rocks,) slenderness angles [rad], in (0, pi/2).
    - `p`: (rocks,) frequency parameters [rad/s], positive.
    - `seen`: for each rock "survived", "toppled", or "rotation" (its largest rotation was measured, and it stands).
    - `restitution`: (rocks,) in [0, 1]; None, or NaN for a rock, is Housner's value, which follows alpha.
    - `alpha_sd`, `p_sd`, `restitution_sd`: (rocks,) or one number: standard deviations, 0 or more, in the units of
      their parameters; those of alpha and p below the value itself. Alpha and p are uncertain by lognormal factors, the
      restitution by a normal term within [0, 0.99].
    - `rotation`, `rotation_sd`: (rocks,) the measured largest |rotation| and its standard deviation [rad], positive,
      below 2 alpha and alpha; not read for rocks without one.
    - `names`: of the rocks; None numbers them.
    - `other`: the `OtherSide` that `Observations.asymmetric` sets; None: symmetric rocks.

    **Raises:** ValueError for values outside their ranges, or of different lengths.
    """

    __repr__ = described

    alpha: Rocks
    p: Rocks
    restitution: Rocks
    alpha_sd: Rocks
    p_sd: Rocks
    restitution_sd: Rocks
    rotation: Rocks
    rotation_sd: Rocks
    follows: Bool[Array, " rocks"]
    seen: Int[Array, " rocks"]
    other: OtherSide | None
    label: Label = eqx.field(static=True)

    @arguments
    def __init__(
        self,
        alpha: Values,
        p: Values,
        seen: Annotated[Sequence[str], list_of(str, "words")],
        restitution: Values | None = None,
        *,
        alpha_sd: Values = 0.0,
        p_sd: Values = 0.0,
        restitution_sd: Values = 0.0,
        rotation: Values | None = None,
        rotation_sd: Values | None = None,
        names: Annotated[Sequence[str] | None, list_of(object, "names")] = None,
        other: OtherSide | None = None,
    ):
        alpha = as_real("alpha", alpha)
        if alpha.ndim != 1 or alpha.size == 0:
            raise ValueError(f"Argument `alpha` must be a list of at least one rock, but has shape {alpha.shape}.")
        count = alpha.size
        self.seen = _words(seen, count)
        restitution = _list("restitution", np.nan if restitution is None else restitution, count)
        self.follows, self.other = _where(_is_missing(restitution), True, False), other
        given = checked("restitution", _where(self.follows, 0.5, restitution), "be in [0, 1]", _in_share)
        block = Block(alpha, _list("p", p, count), given)
        self.alpha, self.p = block.alpha, block.p
        if other is None:
            fitting = Block(_where(self.follows, alpha, 0.5), 1.0).alpha  # raises for one too wide for Housner's value
            self.alpha = _where(self.follows, fitting, self.alpha)
        self.restitution = _where(self.follows, self.by_momentum(self.alpha), given)
        deviations = {"alpha_sd": alpha_sd, "p_sd": p_sd, "restitution_sd": restitution_sd}
        self.alpha_sd, self.p_sd, self.restitution_sd = (
            not_negative(name, _list(name, value, count)) for name, value in deviations.items()
        )
        _check_below("alpha_sd", self.alpha_sd, self.alpha, "`alpha`, and in radians")
        _check_below("p_sd", self.p_sd, self.p, "`p`, and in rad/s")
        measured = np.asarray(self.seen) == SEEN_ROTATION
        self.rotation, self.rotation_sd = (
            _measured(name, value, measured) for name, value in (("rotation", rotation), ("rotation_sd", rotation_sd))
        )
        wider = 1.0 if other is None else if_traced(other.alpha_ratio).clip(1.0)
        most, twice = (_where(measured, by * if_traced(self.alpha) * wider, np.inf) for by in (1, 2))
        _check_below("rotation", self.rotation, twice, "twice `alpha`, from which no rock comes back, and in radians")
        _check_below("rotation_sd", self.rotation_sd, most, "`alpha`, and in radians")
        self.label = Label(tuple(f"rock {i + 1}" for i in range(count)) if names is None else tuple(map(str, names)))
        if len(self.names) != count:
            raise ValueError(f"Argument `names` must have {count} names, but has {len(self.names)}.")

    @classmethod
    @arguments
    def asymmetric(
        cls,
        blocks: AsymmetricBlock,
        seen: Annotated[Sequence[str], list_of(str, "words")],
        restitution: Values | None = None,
        *,
        facing: Values = 0.0,
        **known: Any,
    ) -> "Observations":
        """Return observations of rocks whose sides differ.

        **Arguments:**

        - `blocks`: an `AsymmetricBlock` of (rocks,) arrays.
        - `seen`: as in `Observations`.
        - `restitution`: (rocks,) root of the product of both sides' restitutions, whose ratio is that of `blocks`.
          None, or NaN for a rock: that of `blocks`, which is by angular momentum where none was given.
        - `facing`: (rocks,) or one number: 1 where positive ground acceleration drives the rock from side 1 to side 2,
          as it does a block; -1 for the other orientation; 0 where it is unknown. Orientations of 0 are independent:
          the probabilities of such a rock are means over both. (For a shaking of unknown direction, the same for all
          rocks, state how rocks face each other, and let the amplitude have either sign.)
        - `known`: the other arguments, as in `Observations`. `alpha_sd` and `p_sd` belong to side 1: both angles are
          off by the same factor, and so are both frequency parameters.

        **Returns:** an `Observations`.

        **Raises:** ValueError for values outside their ranges, or of different lengths, and for blocks whose law of
        restitution depends on the speed.
        """
        count = len(seen)
        leaves = ("alpha1", "alpha2", "p1", "p2", "inertia_ratio", "radius_ratio", "restitution1", "restitution2")
        alpha1, alpha2, p1, p2, inertia, radii, first, second = (
            _list(f"blocks.{name}", getattr(blocks, name), count) for name in leaves
        )
        facing = checked("facing", _list("facing", facing, count), "be 1, -1 or 0", _is_facing)
        ratio, both = _of_two_impacts(first, second, p1, p2, radii)
        one_way, two_ways = _ways(facing)
        ways = two_ways if is_traced(facing) or np.any(np.asarray(facing) == 0) else one_way
        other = OtherSide(alpha2 / alpha1, radii, inertia, ratio, ways)
        restitution = _list("restitution", np.nan if restitution is None else restitution, count)
        if blocks.law.depends_on_speed:
            raise ValueError("Argument `blocks` must have a restitution that does not depend on the speed of impacts.")
        if not isinstance(blocks.law, AngularMomentum):
            restitution = _where(_is_missing(restitution), both, restitution)
        return cls(alpha1, p1, seen, restitution, other=other, **known)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rocks."""
        return self.label.value

    @property
    def ways(self) -> Inexact[Array, "ways rocks"]:
        """Signs of the motion that each rock may have felt, all equally likely."""
        return to_device(np.ones((1, self.alpha.size))) if self.other is None else self.other.ways

    @property
    def weaker_alpha(self) -> Rocks:
        """Slenderness angle of the weaker side."""
        return self.alpha if self.other is None else self.alpha * jnp.minimum(1.0, self.other.alpha_ratio)

    @property
    def widest(self) -> Rocks:
        """The largest allowed alpha of side 1."""
        if self.other is None:
            return jnp.where(self.follows, 0.955, 1.55)
        return 1.55 / jnp.maximum(1.0, self.other.alpha_ratio)

    def by_momentum(self, alpha: Inexact[Array, "*shape rocks"]) -> Inexact[Array, "*shape rocks"]:
        """Return the restitution by angular momentum: Housner's, or the root of the product of both sides'."""
        return _by_momentum(self.other, alpha, self.p)

    @called_by_users
    def blocks_at(self, alpha: ArrayLike, p: ArrayLike, restitution: ArrayLike | None) -> Block | AsymmetricBlock:
        """Return the rocks with other values on side 1, (..., rocks), unchecked, as one block of arrays."""
        with checks.collect():
            return Block(alpha, p, restitution) if self.other is None else _two_sided(self.other, alpha, p, restitution)

    @property
    def blocks(self) -> Block | AsymmetricBlock:
        """The rocks as they are stated: one `Block` or `AsymmetricBlock` of arrays."""
        return self.blocks_at(self.alpha, self.p, self.restitution)

    @called_by_users
    def of(self, which: ArrayLike) -> "Observations":
        """Return some of the rocks: `which` is an array of their indices, or of a truth value for each."""
        index = _chosen(which, self.alpha.size)
        numbers = ("alpha", "p", "alpha_sd", "p_sd", "restitution_sd", "rotation", "rotation_sd")
        known = {name: getattr(self, name) for name in numbers}
        known |= {"restitution": _where(self.follows, np.nan, self.restitution), "other": self.other}
        words = [SEEN[k] for k in np.asarray(self.seen)[index]]
        names = [self.names[i] for i in index]
        return Observations(seen=words, names=names, **of_each(lambda x: x[..., index], known))


def _two_sided(other: OtherSide, alpha: ArrayLike, p: ArrayLike, restitution: ArrayLike | None) -> AsymmetricBlock:
    root = jnp.sqrt(other.restitution_ratio)
    pair = None if restitution is None else (restitution * root, restitution / root)
    values = (alpha, other.alpha_ratio * alpha, p, other.inertia_ratio, other.radius_ratio)
    alpha1, alpha2, p1, inertia, radii = (jnp.broadcast_to(x, jnp.shape(alpha)) for x in values)
    return AsymmetricBlock(alpha1, alpha2, p1, inertia, radii, pair)


@eqx.filter_jit
def _by_momentum(other: OtherSide | None, alpha: Real, p: Rocks) -> Real:
    """Return the restitution by angular momentum. Without `jit`, JAX would dispatch each operation separately."""
    if other is None:
        return Housner().ratio(Corners(alpha, alpha, p), jnp.zeros_like(alpha))
    with checks.collect():
        block = _two_sided(other, alpha, p, None)
    return jnp.sqrt(block.restitution1 * block.restitution2)


def _is_missing(values: Array) -> Array | np.ndarray:
    return if_traced(values) != if_traced(values)


def _where(which: ArrayLike, this: ArrayLike, that: ArrayLike) -> Array:
    """Return `jnp.where`; concrete values use NumPy, which compiles nothing."""
    if is_traced((which, this, that)):
        return jnp.where(which, this, that)
    return to_device(np.where(which, this, that))


def _chosen(which: ArrayLike, count: int) -> np.ndarray:
    """Return the indices of the selected rocks."""
    known = isinstance(which, (list, tuple, np.ndarray, jax.Array, int, np.integer))
    given = np.asarray(which if known else None)
    good = given.ndim == 1 and given.size > 0
    if good and given.dtype == bool:
        good = given.size == count and bool(given.any())
    elif good:
        good = given.dtype.kind in "iu" and bool(((given >= -count) & (given < count)).all())
    if not good:
        said = f"be numbers of some of {count} rocks, or a truth value for each"
        raise ValueError(f"Argument `which` must {said}, but is {shown(which)}.")
    return np.arange(count)[given]


def _in_share(x):
    return (x >= 0) & (x <= 1)


def _is_facing(x):
    return (x == 0) | (abs(x) == 1)


def _list(name: str, value: Values, count: int) -> Rocks:
    array = as_real(name, value)
    if array.shape not in ((), (count,)):
        each = "one rock" if count == 1 else f"each of {count} rocks"
        raise ValueError(f"Argument `{name}` must have a value for {each}, but has shape {array.shape}.")
    if array.ndim:
        return array
    return jnp.full(count, array) if is_traced(array) else to_device(np.full(count, array))


def _words(seen: Sequence[str], count: int) -> Int[Array, " rocks"]:
    if isinstance(seen, str) or len(seen) != count:
        raise ValueError(f"Argument `seen` must have a word for each of {count} rocks, but is {seen!r}.")
    for word in seen:
        if called(word) is None:
            told = f"must hold only {', '.join(map(repr, SEEN))}, but holds {word!r}.{did_you_mean(word, CALLED)}"
            raise ValueError(f"Argument `seen` {told}")
    with jax.ensure_compile_time_eval():  # the result stays concrete within `jax.jit`
        return to_device(np.array([SEEN.index(called(word)) for word in seen]))


def called(word: str) -> str | None:
    """Return the canonical word of `SEEN` for an observed outcome; None for an unknown word."""
    return CALLED.get(word.strip().lower()) if isinstance(word, str) else None


def _check_below(name: str, value: Rocks, most: Rocks, what: str) -> None:
    """Raise ValueError where a concrete value reaches a concrete bound, which suggests a wrong unit."""
    if is_traced((value, most)):
        return
    known, most = np.asarray(value), np.asarray(most)
    if (known >= most).any():
        raise ValueError(f"Argument `{name}` must be below {what}, but is {known[known >= most][0]:.4g}.")


def _measured(name: str, value: Values | None, measured: np.ndarray) -> Rocks:
    """Return the values of rocks with a measured rotation; 1 for the others."""
    if value is None and measured.any():
        raise ValueError(f'Argument `{name}` must be given where `seen` is "rotation".')
    array = _list(name, 1.0 if value is None else value, measured.size)
    return checked(name, _where(measured, array, 1.0), "be in (0, pi/2)", lambda x: (x > 0) & (x < np.pi / 2))


@one_program
def _of_two_impacts(first: Rocks, second: Rocks, p1: Rocks, p2: Rocks, radii: Rocks) -> tuple[Rocks, Rocks]:
    """Return the ratio of the restitutions of both sides, and the root of their product."""
    # By angular momentum both restitutions have the same numerator, so that their ratio is I1/I2.
    ratio = jnp.where((first > 0) & (second > 0), first / second, (p2 / p1) ** 2 / radii)
    return ratio, jnp.sqrt(first * second)


@one_program
def _ways(facing: Rocks) -> tuple[Real, Real]:
    """Return signs of the motion, (ways, rocks): if all orientations are known, and if not."""
    both = jnp.stack([jnp.where(facing == 0, sign, facing) for sign in (1.0, -1.0)])
    return both[:1], both
