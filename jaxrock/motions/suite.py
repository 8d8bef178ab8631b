"""Suites: many ground motions, of any kinds, with their peaks."""

from collections.abc import Callable, Iterator, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrock._arguments import arguments, list_of
from jaxrock._parameters import broadcast, leaves_of, one_of_many
from jaxrock.motions.intensity import peak_acceleration, peak_velocity
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.record import with_room

_LEAST = 1e-12  # [g]; what is scaled to a level is divided by its peak


class Suite(eqx.Module):
    """Ground motions of any kinds, with their peaks.

    **Arguments:**

    - `motions`: a list of motions; one whose parameters are arrays of shape (n,) is an ensemble of n.
    - `names`: of the motions; None: those of records, or the kind, with numbers.

    `peak_acceleration` [g] and `peak_velocity` [m/s] are (motions,).

    **Raises:** ValueError if there are no motions, or names in another number; for a motion that does not move.
    """

    groups: tuple[AbstractMotion, ...]  # each of many motions; of samples that all of it share, there is one set
    names: tuple[str, ...] = eqx.field(static=True)
    peak_acceleration: Float[Array, " motions"]
    peak_velocity: Float[Array, " motions"]

    @arguments
    def __init__(
        self,
        motions: Annotated[Sequence[AbstractMotion], list_of(AbstractMotion, "motions")],
        names: Annotated[Sequence[str] | None, list_of(str, "words")] = None,
    ):
        if not motions:
            raise ValueError("Argument `motions` must hold at least one motion, but is empty.")
        self.groups = tuple(map(_ensemble, motions))
        own = [name for motion, group in zip(motions, self.groups) for name in _names(motion, size_of(group))]
        self.names = tuple(own if names is None else names)
        if len(self.names) != len(own):
            raise ValueError(f"Argument `names` must name {len(own)} motions, but has {len(self.names)} names.")
        self.peak_acceleration = jnp.concatenate([_each(peak_acceleration, group) for group in self.groups])
        self.peak_velocity = jnp.concatenate([_each(peak_velocity, group) for group in self.groups])
        for name, peak in zip(self.names, np.asarray(self.peak_acceleration)):
            if not peak > _LEAST:
                raise ValueError(f"Argument `motions` must move the ground, but {name!r} does not.")

    def __len__(self) -> int:
        return len(self.names)

    def motions(self) -> Iterator[AbstractMotion]:
        """Its motions, one by one."""
        for group in self.groups:
            for index in range(size_of(group)):
                yield one_of_many(group, index)


def _ensemble(motion: AbstractMotion) -> AbstractMotion:
    """A motion whose numbers all have the shape (n,); samples stay as they are."""
    leaves = list(leaves_of(motion))
    for leaf in leaves:
        if jnp.ndim(leaf.value) > 1 and leaf.declared.axes is not None:
            raise ValueError(
                f"Motions of a suite must hold numbers or lists of them, but `{leaf.name}` has shape "
                f"{jnp.shape(leaf.value)}."
            )
    return broadcast(motion, jnp.broadcast_shapes((1,), *(jnp.shape(x.value) for x in leaves if not x.is_shared)))


def size_of(group: AbstractMotion) -> int:
    """Number of motions in a group."""
    return next(leaf.value.shape[0] for leaf in leaves_of(group) if not leaf.is_shared)


def _names(motion: AbstractMotion, size: int) -> list[str]:
    name = getattr(motion, "name", "") or type(motion).__name__
    return [name] if size == 1 else [f"{name} {k + 1}" for k in range(size)]


def _each(measure: Callable, group: AbstractMotion):
    group = with_room(group)  # and who draws up a suite is not warned of every record's baseline
    if size_of(group) == 1:  # of what is traced for one motion, there are programs already
        return jnp.reshape(measure(one_of_many(group, 0)), (1,))
    return jax.vmap(lambda index: measure(one_of_many(group, index)))(jnp.arange(size_of(group)))
