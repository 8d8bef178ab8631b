"""Keeping XLA's CPU backend from computing the same thing again."""

import jax
import jax.numpy as jnp

_kept = jax.make_user_context(True)  # each thread's own, and what JAX traced in one is not used in the other


def nothing_kept():
    """A context for programs that XLA does not compile: what is traced meanwhile keeps nothing."""
    return _kept(False)


def _needed() -> bool:
    return _kept.value and jax.default_backend() == "cpu"


def unseen_one(witness):
    """The number one, in a way that the compiler cannot see; `witness`: a number that is known at run time only and
    never negative."""
    if not _needed():
        return jnp.ones_like(witness)
    # An exponential is never repeated either, and its underflow is exact.
    return 1 + jnp.exp(jnp.where(witness < 0, 0.0, -2000.0).astype(jnp.asarray(witness).dtype))


def keep_by(value, one):
    """Mark a value that many others use: it is computed once.

    On CPUs, XLA computes a cheap value again in every loop that uses it, so that a series, whose terms each use
    all before, would be computed dozens of times a step. A division is never repeated: this one is by an
    `unseen_one`.
    """
    return value / one if _needed() else value


def keep(value, witness):
    """As `keep_by`, from a witness of the one."""
    return value / jnp.where(witness < 0, 2.0, 1.0).astype(jnp.asarray(value).dtype) if _needed() else value


def keep_flag(flag, witness):
    """As `keep`, of a condition."""
    return keep(jnp.where(flag, 1.0, 0.0).astype(jnp.asarray(witness).dtype), witness) > 0.5 if _needed() else flag
