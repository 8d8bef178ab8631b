"""What rocks have shown: which stand, which fell, how far one rocked, and how well each of them is known."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._checks import Values, as_real, checked
from jaxrock.block import Block

SEEN = ("survived", "toppled", "rotation")
SURVIVED, TOPPLED, ROTATION = range(3)

Rocks = Inexact[Array, " rocks"]


class Observations(eqx.Module):
    """Rocks at one site, and what each of them did in one shaking.

    **Arguments:**

    - `alpha`: (rocks,) slenderness angles [rad], in (0, pi/2).
    - `p`: (rocks,) frequency parameters [rad/s], positive.
    - `seen`: for each rock "survived", "toppled", or "rotation" (its largest rotation was measured, and it stands).
    - `restitution`: (rocks,) in [0, 1]; None, or NaN for a rock, is Housner's value, which follows alpha.
    - `alpha_sd`, `p_sd`, `restitution_sd`: (rocks,) or one number: standard deviations, 0 or more, in the units of what
      they belong to. Alpha and p are uncertain by lognormal factors, the restitution by a normal sum within [0, 0.99].
    - `rotation`, `rotation_sd`: (rocks,) the measured largest |rotation| and its standard deviation [rad], positive;
      not read for rocks without one.
    - `names`: of the rocks; None numbers them.

    **Raises:** ValueError for values outside their ranges, or of different lengths.
    """

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
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        alpha: Values,
        p: Values,
        seen: Sequence[str],
        restitution: Values | None = None,
        *,
        alpha_sd: Values = 0.0,
        p_sd: Values = 0.0,
        restitution_sd: Values = 0.0,
        rotation: Values | None = None,
        rotation_sd: Values | None = None,
        names: Sequence[str] | None = None,
    ):
        alpha = as_real("alpha", alpha)
        if alpha.ndim != 1 or alpha.size == 0:
            raise ValueError(f"Argument `alpha` must be a list of at least one rock, but has shape {alpha.shape}.")
        count = alpha.size
        self.seen = _words(seen, count)
        restitution = _list("restitution", np.nan if restitution is None else restitution, count)
        self.follows = jnp.isnan(restitution)
        given = checked("restitution", jnp.where(self.follows, 0.5, restitution), "be in [0, 1]", _in_share)
        block = Block(alpha, _list("p", p, count), given)
        own = np.asarray(alpha)[np.asarray(self.follows)]
        housner = Block(own, jnp.ones(own.size)).restitution  # raises for a rock too wide for Housner's value
        self.alpha, self.p = block.alpha, block.p
        self.restitution = given.at[np.flatnonzero(self.follows)].set(housner)
        deviations = {"alpha_sd": alpha_sd, "p_sd": p_sd, "restitution_sd": restitution_sd}
        self.alpha_sd, self.p_sd, self.restitution_sd = (
            checked(name, _list(name, value, count), "be 0 or more and finite", lambda x: (x >= 0) & (x < np.inf))
            for name, value in deviations.items()
        )
        measured = np.asarray(self.seen) == ROTATION
        self.rotation, self.rotation_sd = (
            _measured(name, value, measured) for name, value in (("rotation", rotation), ("rotation_sd", rotation_sd))
        )
        self.names = tuple(f"rock {i + 1}" for i in range(count)) if names is None else tuple(map(str, names))
        if len(self.names) != count:
            raise ValueError(f"Argument `names` must have {count} names, but has {len(self.names)}.")

    @property
    def blocks(self) -> Block:
        """The rocks as they are stated: one `Block` of arrays."""
        return Block(self.alpha, self.p, self.restitution)

    def of(self, which: ArrayLike) -> "Observations":
        """Some of the rocks: `which` is an array of their numbers, or of a truth value for each."""
        index = np.arange(self.alpha.size)[np.asarray(which)]
        known = {
            name: getattr(self, name)[index]
            for name in ("alpha_sd", "p_sd", "restitution_sd", "rotation", "rotation_sd")
        }
        restitution = jnp.where(self.follows, jnp.nan, self.restitution)[index]
        words = [SEEN[k] for k in np.asarray(self.seen)[index]]
        names = [self.names[i] for i in index]
        return Observations(self.alpha[index], self.p[index], words, restitution, **known, names=names)


def _in_share(x):
    return (x >= 0) & (x <= 1)


def _list(name: str, value: Values, count: int) -> Rocks:
    array = as_real(name, value)
    if array.shape not in ((), (count,)):
        raise ValueError(f"Argument `{name}` must have a value for each of {count} rocks, but has shape {array.shape}.")
    return jnp.broadcast_to(array, (count,))


def _words(seen: Sequence[str], count: int) -> Int[Array, " rocks"]:
    if isinstance(seen, str) or len(seen) != count:
        raise ValueError(f"Argument `seen` must have a word for each of {count} rocks, but is {seen!r}.")
    for word in seen:
        if word not in SEEN:
            raise ValueError(f"Argument `seen` must hold only {', '.join(map(repr, SEEN))}, but holds {word!r}.")
    return jnp.asarray([SEEN.index(word) for word in seen])


def _measured(name: str, value: Values | None, measured: np.ndarray) -> Rocks:
    """Values of the rocks with a measured rotation; 1 for the others."""
    if value is None and measured.any():
        raise ValueError(f'Argument `{name}` must be given where `seen` is "rotation".')
    array = _list(name, 1.0 if value is None else value, measured.size)
    return checked(name, jnp.where(measured, array, 1.0), "be in (0, pi/2)", lambda x: (x > 0) & (x < np.pi / 2))
