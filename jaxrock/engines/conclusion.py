"""The end of a scene: the numbers of an outcome from the last state of a block."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrock._core.types import Real
from jaxrock.compiler.hints import select
from jaxrock.engines.state import ROUNDING, State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.status import Status


class Conclusion(eqx.Module):
    """The numbers of a scene that has come to its end, as `Outcome` documents them."""

    max_rotation: Real
    max_velocity: Real
    time_of_max: Real
    impact_count: Int[Array, "..."]
    large_impact_count: Int[Array, "..."]
    overturned: Bool[Array, "..."]
    overturned_share: Real
    margin: Real
    differentiable: Bool[Array, "..."]
    clearance: Real
    error: Real
    known_until: Real
    status: Status

    @classmethod
    def blank(cls, like: Real) -> "Conclusion":
        """Return zeros, in the precision of a number."""
        real, count, flag = jnp.zeros_like(like), jnp.zeros_like(like, jnp.int32), jnp.zeros_like(like, bool)
        status = Status.where(flag, Status.undecided, Status.successful)
        return cls(real, real, real, count, count, flag, real, real, flag, real, real, real, status)


def has_one_peak(peak: Real, second: Real, clearance: Real, alpha: Real) -> Bool[Array, "..."]:
    """Return whether neither another peak ties with the highest, nor an impact is grazed before it."""
    equal = max(1e-9, ROUNDING * float(jnp.finfo(peak.dtype).eps))
    tie = (peak - second <= equal * peak) & (peak > 0)
    return ~tie & ~(clearance <= equal * alpha)


def conclude(stepper: AbstractStepper, state: State) -> Conclusion:
    """Add the free stage to a state at the end of the motion (or where the block was lost)."""
    final = stepper.finish(state)
    overturned = final.overturned
    impacts = final.impacts, final.large_impacts
    if final.counts is not None:
        impacts = tuple(select(overturned, whole, own) for whole, own in zip(impacts, final.counts))

    def unless_overturned(value):
        return select(overturned, jnp.inf, value)

    # A block that stands still in balance goes nowhere, however many steps it takes.
    eps = jnp.finfo(state.closeness.dtype).eps
    unfinished = Status.where(state.closeness > eps, Status.step_budget_exhausted, Status.undecided)
    is_smooth = has_one_peak(final.peak, final.second, final.peak_clearance, stepper.scene.alpha)
    margin = select(overturned, -final.closeness_beyond, final.closeness)
    status = Status.where(state.done, final.status, unfinished)
    status = Status.where(jnp.isnan(margin), Status.not_finite, status)
    return Conclusion(
        max_rotation=unless_overturned(final.peak),
        max_velocity=unless_overturned(final.fastest * stepper.scene.p),
        time_of_max=unless_overturned(final.peak_time),
        impact_count=impacts[0],
        large_impact_count=impacts[1],
        overturned=overturned,
        overturned_share=_share(status, overturned, margin.dtype),
        margin=margin,
        differentiable=is_smooth & ~overturned,
        clearance=select(overturned, final.clearance, final.peak_clearance),
        error=unless_overturned(final.error),
        known_until=jnp.full_like(margin, jnp.inf),
        status=status,
    )


def _share(status: Status, overturned: Bool[Array, ""], dtype: Any) -> Real:
    """Return the share that overturns: one half where nothing but the status `undecided` is known."""
    share = select(status == Status.undecided, 0.5, select(overturned, 1.0, 0.0))
    return select((status == Status.undecided) | (status == Status.successful), share, jnp.nan).astype(dtype)
