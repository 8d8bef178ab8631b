"""Keeping XLA's CPU backend from computing the same thing again."""

import jax
import jax.numpy as jnp


def keep(value, witness):
    """Mark a value that many others use: it is computed once.

    On CPUs, XLA computes a cheap value again in every loop that uses it, so that a series, whose terms each use
    all before, would be computed dozens of times a step. A division is never repeated: this one is by a one
    that the compiler cannot see. `witness` is any number that is known at run time only and never negative.
    """
    if jax.default_backend() != "cpu":
        return value
    return value / jnp.where(witness < 0, 2.0, 1.0).astype(jnp.asarray(value).dtype)
