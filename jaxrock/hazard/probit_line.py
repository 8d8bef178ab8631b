"""Probit regression: the log-likelihood of outcomes, the maximum-likelihood line, and score tests of its slopes."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr

from jaxrock._core.arrays import is_concrete, to_device
from jaxrock.compiler.hints import padded_size


def padded_counts(lists, toppled, survived, labels=None):
    """Pad concrete lists, counts of toppled and survived, and labels with rows whose counts are zero.

    Padding to few common lengths lets a few compiled programs serve fits of all lengths. Inputs that are traced, or on
    a device, return unchanged.
    """
    if not is_concrete((lists, toppled, survived)):
        return lists, toppled, survived, labels
    more = (0, padded_size(np.size(toppled)) - np.size(toppled))
    lists = [np.pad(np.asarray(x), more, "edge") for x in lists]
    counts = (np.pad(np.asarray(x), more) for x in (toppled, survived))
    return *to_device((lists, *counts)), None if labels is None else to_device(np.pad(np.asarray(labels), more))


def most_clusters(count: int) -> int:
    """Return the padded number of clusters; clusters without a row change nothing."""
    return padded_size(count) if count else 0


def probit(z, toppled, survived):
    """Return the log-likelihood of outcomes with probability Phi(z), and its first and second derivatives by each z."""
    signed, counts = jnp.stack([z, -z]), jnp.stack([toppled, survived])
    logarithm = log_ndtr(signed)
    ratio = jnp.exp(-(signed**2) / 2 - logarithm) / math.sqrt(2 * math.pi)
    slopes = counts * ratio
    return jnp.sum(counts * logarithm), slopes[0] - slopes[1], -jnp.sum(slopes * (signed + ratio), axis=0)


def probit_line(abscissas, toppled, survived):
    """Return the maximum-likelihood intercept and slopes of z, by (slopes, n) abscissas, and whether Newton converged.

    The log-likelihood is concave, so that a step of Newton's method, shortened where it is too long, always climbs.
    """

    def newton(abscissas, slope, curvature):
        rows = jnp.concatenate([jnp.ones_like(abscissas[:1]), abscissas])
        return jnp.linalg.solve(rows @ (-curvature[:, None] * rows.T), rows @ slope)

    fixed = jax.lax.stop_gradient((abscissas, toppled, survived))
    shares = 0.5 ** jnp.arange(8, dtype=abscissas.dtype)

    def step(carry):
        line, derivatives, _, count = carry
        change = newton(fixed[0], *derivatives)
        candidates = line + shares[:, None] * change
        # Derivatives at all candidates, though only those of the best are needed: `probit` is compiled only once.
        climbed, *found = jax.vmap(lambda line: probit(line[0] + line[1:] @ fixed[0], *fixed[1:]))(candidates)
        best = jnp.argmax(climbed)
        return candidates[best], tuple(x[best] for x in found), jnp.max(jnp.abs(change)), count + 1

    dtype = abscissas.dtype
    tight, ratio = jnp.sqrt(jnp.finfo(dtype).eps), math.sqrt(2 / math.pi)
    level = ratio * (fixed[1] - fixed[2]), -(ratio**2) * (fixed[1] + fixed[2])  # derivatives where z is 0
    start = jnp.zeros(1 + len(abscissas), dtype), level, jnp.asarray(jnp.inf, dtype), 0
    line, _, change, _ = jax.lax.while_loop(lambda carry: (carry[2] > tight) & (carry[3] < 50), step, start)
    # One more step, through which JAX differentiates by the data: its first derivatives are exact.
    _, *derivatives = probit(line[0] + line[1:] @ abscissas, toppled, survived)
    return line + newton(abscissas, *derivatives), change <= tight


def slope_tests(abscissas, toppled, survived, labels=None, count=0, most: int = 0):
    """Return p-values of the slopes, (slopes,): the probability of such a slope if outcomes do not depend on it.

    Each is Rao's score test with the observed information, at the line whose tested slope is zero. (A Wald test loses
    power the better outcomes are separated.) With `labels`, the scatter of the clusters' scores replaces the
    information; there are `count` clusters, and room for `most`.

    The p-value is 1 where no slope can be identified: the abscissa is constant, all outcomes are equal or are separated
    by the other abscissas, or the scores of each cluster cancel.
    """

    def test(tested, others):
        rows = jnp.concatenate([jnp.ones_like(abscissas[:1]), others, tested[None]])
        if len(others):
            line = probit_line(others, toppled, survived)[0]
        else:
            line = jax.scipy.special.ndtri(jnp.where(mixed, jnp.sum(toppled) / jnp.sum(toppled + survived), 0.5))[None]
        likelihood, by_z, curvature = probit(line @ rows[:-1], toppled, survived)
        information = rows @ (-curvature[:, None] * rows.T)
        combination = jnp.append(-jnp.linalg.solve(information[:-1, :-1], information[:-1, -1]), 1.0)
        scores = (combination @ rows) * by_z
        if labels is None:
            scatter = combination @ information @ combination
        else:
            scatter = jnp.sum(jnp.zeros(most).at[labels].add(scores) ** 2) * count / (count - 1)
        rounding = 8 * jnp.finfo(scores.dtype).eps * jnp.sum(jnp.abs(scores))
        nothing = ~mixed | (likelihood >= -1e-6) | (jnp.ptp(tested) <= 1e-9) | (scatter <= rounding**2)
        ratio = jnp.abs(jnp.sum(scores)) / jnp.sqrt(2 * jnp.where(nothing, 1.0, scatter))
        return jnp.where(nothing, 1.0, jax.lax.erfc(ratio))

    mixed = (jnp.sum(toppled) > 0) & (jnp.sum(survived) > 0)
    if len(abscissas) == 1:
        return test(abscissas[0], abscissas[:0])[None]
    rests = np.array([np.delete(np.arange(len(abscissas)), index) for index in range(len(abscissas))])
    return jax.lax.map(
        lambda index: test(abscissas[index], abscissas[jnp.asarray(rests)[index]]), np.arange(len(rests))
    )
