"""Scale laws: dimensionless and orientationless groups, in which blocks and motions of all sizes respond alike.

The rocking of a slender block under a motion of given form, with peak a_g and frequency omega_g, depends on three
numbers: omega_g/p, g alpha/a_g and the restitution. For any rigid block g tan(alpha)/a_g replaces the second, and
cos(alpha) is a fourth. As long as rotations are small, dividing them by cos(alpha) removes this dependence.
`orientations` computes why such groups have neither dimension nor orientation.

The groups of a pulse are its uplift strength, its duration times p, and its further parameters: see `groups_of` and
`motion`.

**Source:** Dimitrakopoulos & DeJong (2012), sections 4 to 6; Voyagaki, Psycharis & Mylonakis (2012), 2.2.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import declared
from jaxrock._arguments.ranges import not_nan, one_of, positive, share, size
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import as_real, is_traced
from jaxrock._core.types import Real
from jaxrock.blocks.restitution import tells_sides
from jaxrock.blocks.rigid import Block
from jaxrock.motions.pulses.pulse import AbstractPulse
from jaxrock.responses.history import Response
from jaxrock.studies import orientations as orientations

__all__ = ["Groups", "Scales", "block", "groups", "groups_of", "master_curve", "motion", "orientations", "scales"]


def __dir__() -> list[str]:
    return __all__


_KINDS = ("slender", "rigid")


class Groups(eqx.Module):
    """Numbers that are equal for all blocks and motions that respond alike.

    - `frequency_ratio`: omega_g/p [-].
    - `strength`: g alpha/a_g (slender) or g tan(alpha)/a_g (rigid) [-]: one over the intensity.
    - `restitution`: [-].
    - `cos_alpha`: None for slender blocks, for which it plays no part.
    - `others`: further parameters of a pulse by name [-]; those that are times are multiplied by p.
    """

    __repr__ = described

    frequency_ratio: Real
    strength: Real
    restitution: Real
    cos_alpha: Real | None = None
    others: dict[str, Real] = eqx.field(default_factory=dict)

    @classmethod
    def of_duration(
        cls,
        uplift_strength: ArrayLike,
        pulse_duration: ArrayLike,
        restitution: ArrayLike,
        cos_alpha: ArrayLike | None = None,
        **others: ArrayLike,
    ) -> "Groups":
        """Make groups from the numbers of single-lobe pulses: uplift threshold over peak, and p times the duration [-].

        **Arguments:**

        - `uplift_strength`, `pulse_duration`: positive.
        - `restitution`, `cos_alpha`: as the fields of `Groups`.
        - `others`: further parameters of the pulse, such as `shape=0.5`.

        **Raises:** ValueError for arguments outside their ranges.

        **Source:** Voyagaki, Psycharis & Mylonakis (2012), section 2.
        """
        ratio = 2 * jnp.pi / positive("pulse_duration", pulse_duration)
        known = {name: not_nan(name, value) for name, value in others.items()}
        cos_alpha = None if cos_alpha is None else share("cos_alpha", cos_alpha)
        strength, restitution = positive("uplift_strength", uplift_strength), share("restitution", restitution)
        return cls(ratio, strength, restitution, cos_alpha, known)

    @property
    def pulse_duration(self) -> Real:
        """p times the duration (or period) of the pulse [-]."""
        return 2 * jnp.pi / self.frequency_ratio


class Scales(eqx.Module):
    """Units of dimensionless results: divide by them to make a result dimensionless, multiply to convert it back.

    - `time`: [s]; `rotation`: [rad]; `velocity`: [rad/s].
    """

    __repr__ = described

    time: Real
    rotation: Real
    velocity: Real


@arguments
def groups(block: Block, amplitude: ArrayLike, frequency: ArrayLike, kind: str = "rigid") -> Groups:
    """Compute the groups of a block under a motion.

    **Arguments:**

    - `block`: a `Block`.
    - `amplitude`: peak a_g of the motion [g], positive.
    - `frequency`: its angular frequency omega_g [rad/s], positive; 2 pi over the period of a pulse.
    - `kind`: "rigid" for any block, "slender" for one in the linear model.

    **Returns:** `Groups`.

    **Source:** Dimitrakopoulos & DeJong (2012), equations 4.11 (slender) and 5.3 (rigid).
    """
    amplitude, frequency = size("amplitude", amplitude), size("frequency", frequency)
    _check_law(block)
    if one_of("kind", kind, _KINDS) == "slender":
        return Groups(frequency / block.p, block.alpha / amplitude, block.restitution)  # 4.11
    return Groups(frequency / block.p, jnp.tan(block.alpha) / amplitude, block.restitution, jnp.cos(block.alpha))  # 5.3


@arguments
def groups_of(block: Block, pulse: AbstractPulse, kind: str = "rigid") -> Groups:
    """Compute the groups of a block under a pulse: uplift strength, duration, and the pulse's further parameters.

    **Arguments:**

    - `block`, `kind`: as in `groups`.
    - `pulse`: any pulse; the sign of its amplitude plays no part.

    **Returns:** `Groups`, from which `motion` makes the pulse again, for this block or for another.

    **Source:** Voyagaki, Psycharis & Mylonakis (2012), 2.2; Dimitrakopoulos & DeJong (2012), 4.11 and 5.3.
    """
    (peak, extent), others = _parts(type(pulse))
    found = groups(block, jnp.abs(getattr(pulse, peak)), 2 * jnp.pi / getattr(pulse, extent), kind)
    rates = {name: block.p if is_time else 1.0 for name, is_time in others.items()}
    return eqx.tree_at(lambda g: g.others, found, {name: getattr(pulse, name) * rate for name, rate in rates.items()})


def _parts(form: Callable) -> tuple[list[str], dict[str, bool]]:
    """Return the names of a pulse's amplitude and duration (or period); then which other parameters are times."""
    known = declared(form.func if isinstance(form, functools.partial) else form)  # type: ignore[arg-type]  # a class
    names = list(known)
    return names[:2], {name: known[name].unit == "s" for name in names[2:]}


def _check_law(block: Block) -> None:
    if block.law.depends_on_speed:
        raise ValueError("Argument `block` must have a restitution that does not depend on the speed of impacts.")
    if block.opens is not None:
        raise ValueError("Argument `block` must rock to both sides: groups do not tell the side to which a wall opens.")
    if tells_sides(block.law, block.corners):
        raise ValueError("Argument `block` must have a restitution that is the same on both sides.")


@arguments
def block(groups: Groups, amplitude: ArrayLike, frequency: ArrayLike) -> Block:
    """Return the slender block that has these groups under a motion with this peak [g] and angular frequency [rad/s].

    **Raises:** ValueError for groups of the kind "rigid", whose alpha is given: ask for the motion instead.
    """
    if groups.cos_alpha is not None:
        raise ValueError("Argument `groups` must be of slender blocks: a rigid one's alpha is given. Use `motion`.")
    alpha = groups.strength * size("amplitude", amplitude)
    return Block(alpha, size("frequency", frequency) / groups.frequency_ratio, groups.restitution)


@arguments
def motion(groups: Groups, block: Block, form: Callable):
    """Return the motion under which a block has these groups.

    **Arguments:**

    - `groups`: `Groups`.
    - `block`: a `Block` of any size with the restitution of the groups and, for groups of rigid blocks, with their
      alpha.
    - `form`: makes a motion from peak [g] and period or duration [s], such as `SinePulse`. It must be a pulse if the
      groups hold further parameters of one.

    **Returns:** the motion that `form` makes.

    **Raises:** ValueError for a block that is known not to have these groups under any motion, and for a pulse without
    their other parameters.
    """
    _check_law(block)
    own = {"restitution": (groups.restitution, block.restitution)}
    if groups.cos_alpha is not None:
        own["cosine of alpha"] = (groups.cos_alpha, jnp.cos(block.alpha))
    for name, (wanted, found) in own.items():
        if not is_traced((wanted, found)) and not np.allclose(wanted, found, rtol=1e-6, atol=1e-6):
            raise ValueError(f"Argument `block` must have the {name} of the groups, {wanted}, but has {found}.")
    if groups.others and not groups.others.keys() <= _parts(form)[1].keys():
        raise ValueError(f"Argument `form` must have the parameters {[*groups.others]} of the groups, but has not.")
    threshold = block.alpha if groups.cos_alpha is None else jnp.tan(block.alpha)
    are_times = _parts(form)[1] if groups.others else {}
    others = {name: value / block.p if are_times[name] else value for name, value in groups.others.items()}
    return form(threshold / groups.strength, 2 * jnp.pi / (groups.frequency_ratio * block.p), **others)


@arguments
def scales(block: Block, amplitude: ArrayLike | None = None, kind: str = "rigid") -> Scales:
    """Return the units in which responses of similar blocks are one curve.

    **Arguments:**

    - `block`: a `Block`.
    - `amplitude`: peak a_g of the motion [g]: rotations are measured by the motion. None: by alpha.
    - `kind`: "slender", or "rigid". With an amplitude, "rigid" also divides rotations by cos(alpha). This makes the
      response of blocks with different alpha nearly one curve as long as rotations are small.

    **Returns:** `Scales`.

    **Source:** Dimitrakopoulos & DeJong (2012), equations 4.10, 4.11 and 6.1.
    """
    factor = jnp.cos(block.alpha) if one_of("kind", kind, _KINDS) == "rigid" else jnp.ones_like(block.alpha)
    rotation = block.alpha if amplitude is None else size("amplitude", amplitude) * factor
    return Scales(1 / block.p, rotation, block.p * rotation)


@arguments
def master_curve(response: Response, scales: Scales, dimensionless_time: ArrayLike) -> tuple[Real, Real]:
    """Return rotation and velocity of a response in dimensionless terms.

    **Arguments:**

    - `response`: result of `simulate`.
    - `scales`: from `scales`.
    - `dimensionless_time`: p t, (n,).

    **Returns:** (rotation, velocity) over their scales, (n,) each.

    **Source:** Dimitrakopoulos & DeJong (2012), figures 6 and 11.
    """
    rotation, velocity = response(as_real("dimensionless_time", dimensionless_time) * scales.time)
    return rotation / scales.rotation, velocity / scales.velocity
