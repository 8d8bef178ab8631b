"""The probability of observations of rocks under a motion.

A known block under a known motion stands or falls by the sign of its margin. Neither is known. The motion at each rock
differs from that of the site by a lognormal factor. `scatter` is its standard deviation in ln amplitude: variation of
the ground, and errors of the model of a rigid block in a plane. The parameters alpha, p and restitution are uncertain,
too. The probability that a rock stands is the share of these possible scenes with a positive margin:

    P(stands) = E[margin > 0],  over  ln amplitude + scatter e0,  ln alpha + (alpha_sd/alpha) e1,  ln p + (p_sd/p) e2,
    restitution + restitution_sd e3,  all e independent and normal.

A probit of the margin over its slope (the delta method) would give that where the margin is straight. But overturning
sets are unions of intervals, narrower than the scatter or wider. A probit with one slope would be certain where the
slope vanishes, in the middle of an interval. So the margin is computed at many amplitudes (see `scatter`).

The likelihood needs no derivatives, and its slope only first ones. `accuracy` chooses the error of probabilities, and
`survival_error` estimates it; `benchmarks/inverse.md` compares it with counted verdicts.

The orientation of an asymmetric rock in the shaking may be unknown. Its probability is then the mean over both.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.ranges import below_one, positive, scalar
from jaxrock._core.arrays import as_real, check_shapes, shown, to_device
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Real
from jaxrock.compiler import checks, trace_function
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.observations import SEEN_ROTATION, SEEN_TOPPLED, Flags, Observations
from jaxrock.inverse.scatter import Possible, Quadrature, are_known_well, levels_around, quadrature_accuracy
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.mirrored import scaled_and_mirrored
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.pulse import AbstractPulse
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import outcome
from jaxrock.status import Status, is_decided, still_where
from jaxrock.studies.search_axis import known_margin

# Margin and rotation, overturned, known, and the share that overturns where chaos leaves the verdict open, else NaN.
_Found = tuple[Real, Flags, Flags, Real]
_NO_STRENGTH = 1e-30  # [g]
_DRAWS = 8  # random quadratures from which the error of the quadrature is estimated
_FLAT = -np.log(np.pi / 2)  # log-density of a rotation in (0, pi/2) if only the survival of the rock is known


class Likelihood(eqx.Module):
    """The likelihood of observations as a function of the parameters of a motion.

    **Arguments:**

    - `observations`: an `Observations`.
    - `motion`: any function that makes the motion from its parameters by name, such as `SinePulse`. Each call reads its
      current state (under your `jax.jit`, that of the trace). To scale a record, scale the whole of it:
      `amplitude * rk.Record(samples, dt * stretch)`. With `rk.Record(amplitude * samples, dt)` the likelihood is
      differentiated by every sample, which takes many times as long.
    - `scatter`: standard deviation of ln amplitude from rock to rock [-], positive. It covers local differences of the
      motion and errors of the model; 0.3 is a third up or down.
    - `model`, `engine`: as in `outcome`.
    - `lapse`: probability that an observation is uninformative, in [0, 1). A rock may have been moved or misjudged, or
      stand in an unresolved gap between two ways of overturning. One rock then contradicts a motion by odds of at most
      2/lapse to 1.
    - `accuracy`: approximate root mean square error of a probability by the quadrature over scatter and rocks [-], in
      [0.001, 0.05]. Scenes for each rock: 54 at 0.02, 272 at 0.01, 1,452 at 0.005 and 66,332 at 0.001. They are 42, 82,
      162 and 802 where the scatter of the motion dominates. Single probabilities may be off by four times as much:
      `survival_error` estimates the error of each.

    **Raises:** ValueError for a value outside its range.
    """

    observations: Observations
    scatter: Real
    lapse: Real
    quadrature: Quadrature
    motion: Callable[..., AbstractMotion]
    model: AbstractEquation
    engine: AbstractEngine | None

    @arguments
    def __init__(
        self,
        observations: Observations,
        motion: Callable,
        scatter: ArrayLike = 0.3,
        model: AbstractEquation = Housner(),
        engine: AbstractEngine | None = None,
        lapse: ArrayLike = 0.02,
        *,
        accuracy: Annotated[float, quadrature_accuracy] = 0.02,
    ):
        if isinstance(motion, AbstractMotion):
            raise ValueError(f"Argument `motion` must make a motion of its parameters, but is one: {motion}.")
        self.observations, self.model, self.engine = observations, model, engine
        self.motion = motion if isinstance(motion, eqx.Module) else trace_function(motion)
        self.scatter = scalar("scatter", positive("scatter", scatter))
        self.lapse = scalar("lapse", below_one("lapse", lapse))
        exact = are_known_well(observations, self.scatter, accuracy)
        self.quadrature = Quadrature.of(accuracy, exact)

    @property
    def scenes(self) -> int:
        """Number of scenes computed for one motion."""
        return self.observations.ways.size * self.quadrature.scenes

    def current(self, names: Sequence[str]) -> "Likelihood":
        """Return a pytree for `jax.jit`, with the current state of motion and model, for parameters of such names.

        **Raises:** ValueError where the function of the motion does not take these names.
        """
        _check_names(self.motion, names)
        seen, number = self.observations, jax.ShapeDtypeStruct((), jnp.result_type(float))
        parts = trace_function(self.motion, **dict.fromkeys(names, number)), current_model(self.model, seen.blocks)
        return eqx.tree_at(lambda it: (it.motion, it.model), self, parts)

    @called_by_users
    def log_terms(self, values: Mapping[str, ArrayLike], slopes: bool = True) -> Real:
        """Return the log-likelihood of each rock, (..., rocks), for `values` (...) of the motion's parameters by name.

        It is the logarithm of a probability, or of a density [1/rad] for a measured rotation; minus infinity for
        impossible motions, such as those of negative duration. It has derivatives if `slopes`, and is faster without.
        One call for many motions takes less time than `jax.vmap` of calls for one."""
        return self._compiled(Likelihood.terms, values, slopes)

    def terms(self, values: Mapping[str, ArrayLike], slopes: bool = True, wanted: Flags | None = None) -> Real:
        """Return the result of `log_terms`, within a traced program; skip motions that are not `wanted`, (...)."""
        possible, impossible = self._possible(values, slopes, wanted)
        return self._terms(self._log_probabilities(possible), impossible)

    def _compiled(self, what: Callable, values: Mapping[str, ArrayLike], *how):
        """Run a method as one compiled program; uncompiled, JAX would dispatch each operation separately."""
        given = {name: as_real(name, x) for name, x in values.items()}
        check_shapes(**given)
        return as_program(what, self.current(tuple(values)), given, *how)

    def _log_probabilities(self, possible: Possible) -> Real:
        """Return log-probabilities, without lapse, of standing, toppling, and standing with the measured rotation."""
        seen = self.observations
        variance = possible.rotation_width**2 + seen.rotation_sd**2
        density = -((seen.rotation - possible.rotation) ** 2) / (2 * variance) - jnp.log(2 * jnp.pi * variance) / 2
        # The rotation in a scene that was not computed is unknown: use the flat density.
        density = jnp.where(possible.known, density, _FLAT)
        ends = jnp.full_like(density[:1], _FLAT)
        density = jnp.concatenate([ends, density, ends])
        return possible.log_probabilities(jnp.where(seen.seen == SEEN_ROTATION, density, 0.0))

    def _terms(self, logarithms: Real, impossible: Flags) -> Real:
        seen = self.observations
        _, topples, measured = logarithms
        terms = jnp.where(seen.seen == SEEN_TOPPLED, topples, measured)
        terms = self._or_lapse(terms, jnp.where(seen.seen == SEEN_ROTATION, _FLAT, 0.0))
        return jnp.where(impossible[..., None], -jnp.inf, terms)

    def _or_lapse(self, log_probability: Real, flat: Real | float = 0.0) -> Real:
        """Mix in the probability of a lapse, under which standing and toppling are equally likely."""
        return jnp.logaddexp(jnp.log1p(-self.lapse) + log_probability, jnp.log(self.lapse / 2) + flat)

    @called_by_users
    def survival(self, values: Mapping[str, ArrayLike]) -> Real:
        """Return the probability that each rock stands, (..., rocks), without derivatives."""
        return self._compiled(Likelihood._survival, values)

    @called_by_users
    def survival_error(self, values: Mapping[str, ArrayLike]) -> Real:
        """Estimate the standard error of `survival` by its quadrature, (..., rocks), at eight times its cost.

        Eight quadratures with as many nodes at random places give it (Cranley & Patterson 1976)."""
        found = [np.asarray(each.survival(values)) for each in self.drawn()]
        return to_device(np.std(found, axis=0, ddof=1))

    @called_by_users
    def drawn(self) -> list["Likelihood"]:
        """Return likelihoods by random quadratures with as many nodes; their scatter estimates the error."""
        draws = (self.quadrature.drawn(seed) for seed in range(_DRAWS))
        return [eqx.tree_at(lambda it: it.quadrature, self, each) for each in draws]

    def _survival(self, values: Mapping[str, ArrayLike]) -> Real:
        return jnp.exp(self._possible(values)[0].log_probabilities()[0])

    @called_by_users
    def surprise(self, values: Mapping[str, ArrayLike]) -> tuple[Real, Real, Real]:
        """Return the badness of fit of each rock, its expectation and its variance, (..., rocks) each; no derivatives.

        The badness is minus the log-probability of the outcome. For a measured rotation, half its squared distance from
        the expected rotation, in standard deviations, is added to minus the log-probability that the rock stands.
        """
        return self._compiled(Likelihood._surprise_at, values)

    def _surprise_at(self, values: Mapping[str, ArrayLike]) -> tuple[Real, Real, Real]:
        possible = self._possible(values)[0]
        return self._surprise(possible, possible.log_probabilities())

    def terms_and_facts(
        self, values: Mapping[str, ArrayLike], wanted: Flags | None = None
    ) -> tuple[Real, tuple[Real, Real, Real, Real, Real]]:
        """Return `log_terms`, and `survival`, the share of computed scenes and `surprise`, at the cost of the first.

        For use within a traced program; motions that are not `wanted`, (...), are skipped."""
        possible, impossible = self._possible(values, True, wanted)
        logarithms = self._log_probabilities(possible)
        facts = jnp.exp(logarithms[0]), possible.share_known, *self._surprise(possible, logarithms)
        return self._terms(logarithms, impossible), facts

    def _surprise(self, possible: Possible, logarithms: Real) -> tuple[Real, Real, Real]:
        seen = self.observations
        stands, topples = jnp.maximum(self._or_lapse(logarithms[:2]), -1e3)
        share, lost = jnp.exp(stands), jnp.exp(topples)
        badness = jnp.where(seen.seen == SEEN_TOPPLED, -topples, -stands)
        mean, variance = -(share * stands + lost * topples), share * lost * (stands - topples) ** 2

        # The expected rotation of a rock that stands.
        weight = jnp.where(possible.known, possible.weight * ndtr(possible.y / possible.width), 0.0)
        weight = weight / possible.y.shape[-2]
        total = jnp.maximum(jnp.sum(weight, axis=(0, -2)), 1e-9)
        centre = jnp.sum(weight * possible.rotation, axis=(0, -2)) / total
        spread = possible.rotation_width**2 + (possible.rotation - centre[..., None, :]) ** 2
        spread = seen.rotation_sd**2 + jnp.sum(weight * spread, axis=(0, -2)) / total
        measured = jnp.where((seen.seen == SEEN_ROTATION) & (total > 1e-6), 0.5, 0.0)
        return badness + measured * (seen.rotation - centre) ** 2 / spread, mean + measured, variance + measured

    def _possible(
        self, values: Mapping[str, ArrayLike], slopes: bool = False, wanted: Flags | None = None
    ) -> tuple[Possible, Flags]:
        """Return outcomes in all possible scenes, with first derivatives if `slopes`; and which motions are impossible,
        or not `wanted`."""
        seen, names = self.observations, tuple(values)
        parameters = jnp.stack(jnp.broadcast_arrays(*(as_real(name, x) for name, x in values.items())), axis=-1)
        if not slopes:
            parameters = _without_slopes(parameters)
        outer = parameters.shape[:-1]
        strength, impossible = jax.vmap(lambda x: self._strength(names, x))(parameters.reshape(-1, len(names)))
        strength, impossible = strength.reshape(outer), impossible.reshape(outer)
        levels, where = levels_around(seen, self.quadrature, self.scatter, strength)
        if wanted is not None:  # a scene whose strength is NaN ends at once
            levels = levels._replace(strength=jnp.where(wanted[..., None, None], levels.strength, jnp.nan))
            impossible |= ~wanted
        shape = (*levels.strength.shape[:-1], *seen.ways.shape)  # (nodes, ..., possible, ways, rocks)

        def lanes(x):
            return jnp.broadcast_to(x[..., None, :], shape).ravel()

        parameters = jnp.broadcast_to(parameters[..., None, None, None, :], (*shape, len(names)))
        parameters = parameters.reshape(-1, len(names))
        blocks = jax.tree.map(lanes, seen.blocks_at(levels.alpha, levels.p, levels.restitution))
        ways = jnp.broadcast_to(seen.ways, shape).ravel()
        # `_sloping` attaches known derivatives: JAX differentiates that product only, and not the engine.
        scene = _Scene(self.motion, self.model, self.engine, names)
        fixed, level = jax.lax.stop_gradient((parameters, lanes(levels.strength)))
        if slopes:
            rows, (real, lost, known, share) = scene.rows(fixed, level, ways, blocks)
            real = _sloping(real, rows, parameters, scene, level, ways, blocks)
        else:
            real, lost, known, share = jax.vmap(scene.results)(fixed, level, ways, blocks)[1]
        verge = lanes(levels.alpha * seen.weaker_alpha / seen.alpha)
        # The orientation of a rock and the possible rocks share one axis: all are equally likely.
        merged = (*shape[:-3], -1, shape[-1])
        where, margin, rotation, lost, known, share, verge = (
            x.reshape(merged) for x in (lanes(where), *real.T, lost, known, share, verge)
        )
        margin, rotation = (jnp.where(known, x, 0.0) for x in (margin, rotation))
        return Possible.of(where, margin, rotation, known, lost, verge, self.quadrature.apart, share), impossible

    def _strength(self, names: tuple[str, ...], parameters: Real) -> tuple[Real, Bool[Array, ""]]:
        """Return the logarithm of the strength of a motion, and whether the motion is impossible."""
        with checks.collect() as collected:
            strength = _log_strength(_made(self.motion(**dict(zip(names, parameters)))))
        failed = jnp.stack([~jnp.isfinite(strength), *(bad for _, bad in collected)]).any()
        return jnp.where(failed, 0.0, strength), failed


def _check_names(motion: Callable, names: Sequence[str]) -> None:
    """Raise ValueError where the function of the motion does not take parameters of such names."""
    if not names:
        raise ValueError("Argument `values` must name the parameters of the motion, but is empty.")
    try:
        signature = inspect.signature(motion)
    except ValueError:  # some functions that are not written in Python have no signature
        return
    try:
        signature.bind(**dict.fromkeys(names))
    except TypeError as error:
        raise ValueError(f"Argument `motion` must make a motion of {list(names)}, but: {error}.") from None


def _made(motion: Any) -> AbstractMotion:
    """Return the result of the motion's function; raise ValueError unless it is a motion."""
    if not isinstance(motion, AbstractMotion):
        is_array = isinstance(motion, (jax.Array, np.ndarray))
        what = f"an array of shape {motion.shape}" if is_array else shown(motion)
        raise ValueError(f"Argument `motion` must make a motion of its parameters, but makes {what}.")
    return motion


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def as_program(what: Callable, likelihood: Likelihood, values: Mapping[str, ArrayLike], *how):
    """Run a function of a `current` likelihood, at values by name, as one compiled program."""
    return what(likelihood, values, *how)


def _log_strength(motion: AbstractMotion) -> Real:
    """Return the logarithm of a measure of the acceleration; any measure that grows with it serves."""
    return jnp.log(jnp.maximum(jnp.max(motion.bounds), _NO_STRENGTH))


def _of_strength(motion: AbstractMotion, logarithm: Real, way: Real) -> AbstractMotion:
    """Return the motion scaled to a strength, with the sign `way` (1 or -1).

    The amplitude of a pulse would cancel; only its sign is kept, so that no derivative by it is computed.
    """
    if isinstance(motion, AbstractPulse):
        motion = eqx.tree_at(lambda pulse: pulse.amplitude, motion, jnp.sign(motion.amplitude))
    return scaled_and_mirrored(motion, way * jnp.exp(logarithm - _log_strength(motion)))


class _Scene(eqx.Module):
    """Computes the outcome of one rock in one possible scene."""

    motion: Callable[..., AbstractMotion]
    model: AbstractEquation
    engine: AbstractEngine | None
    names: tuple[str, ...] = eqx.field(static=True)

    def results(self, parameters: Real, level: Real, way: Real, block) -> tuple[Real, _Found]:
        """Return margin and rotation; as auxiliary data these again, and the rest of `_Found`."""
        with checks.collect():  # `_strength` collects the motion's checks, and the rocks have passed theirs
            motion = self.motion(**dict(zip(self.names, parameters)))
            result = outcome(block, _of_strength(motion, level, way), self.model, engine=self.engine)
        rotation = jnp.where(result.overturned, 0.0, result.max_rotation)
        real = still_where(result.status == Status.chaotic, jnp.stack([result.margin, rotation]))
        # Without copies (`known_until` is infinite) nothing tells the share.
        is_open = known_margin(result.margin, result.status)[1] & jnp.isfinite(result.known_until)
        share = jnp.where(is_open, result.overturned_share, jnp.nan)
        return real, (real, result.overturned, is_decided(result.status), jax.lax.stop_gradient(share))

    def rows(self, parameters: Real, level: Real, way: Real, block) -> tuple[Real, _Found]:
        """Return the rows of the Jacobian by the parameters, of many lanes, with the values; zero where not finite."""

        def one(parameters, *lane):
            _, back, found = jax.vjp(lambda x: self.results(x, *lane), parameters, has_aux=True)
            return jnp.stack([back(row)[0] for row in jnp.eye(2)]), found

        rows, found = jax.vmap(one)(parameters, level, way, block)
        return jnp.where(jnp.isfinite(rows), rows, 0.0), found


@eqx.filter_custom_jvp
def _sloping(values: Real, rows: Real, parameters: Real, *lanes) -> Real:
    """Return values, (lanes, results); `rows`, (lanes, results, parameters), are their Jacobian by parameters."""
    return values


@_sloping.def_jvp
def _(primals, tangents):
    if jax.tree.leaves((tangents[0], tangents[3:])):
        raise NotImplementedError(
            "A likelihood has derivatives by the values of the motion's parameters, by scatter and lapse, but not by "
            "the rocks, nor by what the functions of motion and model hold."
        )
    _, rows, parameters, *lanes = primals
    rows = _bending(rows, parameters, *lanes)
    values = _sloping(*primals)  # plain `primals[0]` would lose derivatives of higher order
    return values, jnp.einsum("...ij,...j->...i", rows, tangents[2])


@eqx.filter_custom_jvp
def _bending(rows: Real, parameters: Real, scene: _Scene, *lanes) -> Real:
    """Return rows with their derivatives by parameters, which are computed only for second derivatives."""
    return rows


@_bending.def_jvp
def _(primals, tangents):
    _, parameters, scene, *lanes = primals
    return _bending(*primals), jax.jvp(lambda x: scene.rows(x, *lanes)[0], (parameters,), (tangents[1],))[1]


@jax.custom_jvp
def _without_slopes(parameters: Real) -> Real:
    """Return the parameters, and raise an error on differentiation."""
    return parameters


@_without_slopes.defjvp
def _(primals, tangents):
    raise NotImplementedError("This was computed without derivatives: use `log_terms(values)`, which has them.")
