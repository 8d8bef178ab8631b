"""Registration of `Outcome`, so that `Grid.load` recognises outcomes in saved files by the names of their results."""

import jax.numpy as jnp

from jaxrock.responses.outcome import Outcome
from jaxrock.status import Status
from jaxrock.sweeps.grid import known_again


def an_outcome() -> Outcome:
    """Return an outcome with arbitrary numbers."""
    number, count, verdict = jnp.zeros(()), jnp.zeros((), int), jnp.zeros((), bool)
    return Outcome(
        max_rotation=number, max_velocity=number, time_of_max=number, impact_count=count, large_impact_count=count,
        overturned=verdict, overturned_share=number, margin=number, differentiable=verdict, clearance=number,
        error=number, known_until=number, status=Status.successful,
    )  # fmt: skip


known_again(an_outcome)
