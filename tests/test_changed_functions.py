"""User functions that change after they were passed: every call uses them as they are then."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.compiler import trace_function
from jaxrock.compiler.jaxpr.traced_function import TracedFunction
from jaxrock.responses.current_model import current_model

COMPILED = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, duration, **_: COMPILED.append(event) if event.endswith("backend_compile_duration") else None
)


# Ways of changing a function: each takes `use(size, *arguments)` and gives what is to be called, and what makes its
# size 2 instead of 1. Sizes are arrays, so that what is compiled serves all of them.

SIZE = None


def a_global(use):
    def change(size):
        global SIZE
        SIZE = jnp.array([size])

    change(1.0)
    return lambda *a: use(SIZE, *a), functools.partial(change, 2.0)


def a_closure_cell(use):
    size = jnp.ones(1)

    def change():
        nonlocal size
        size = jnp.array([2.0])

    return lambda *a: use(size, *a), change


class Holder:
    def __init__(self, use):
        self.use, self.size = use, jnp.ones(1)

    def __call__(self, *arguments):
        return self.use(self.size, *arguments)

    def method(self, *arguments):
        return self.use(self.size, *arguments)

    def change(self):
        self.size = jnp.array([2.0])


def an_attribute(use):
    holder = Holder(use)
    return lambda *a: use(holder.size, *a), holder.change


def a_method(use):
    holder = Holder(use)
    return holder.method, holder.change


def an_instance(use):
    holder = Holder(use)
    return holder, holder.change


def a_partial(use):
    sizes = {"now": jnp.ones(1)}

    def function(sizes, *arguments):
        return use(sizes["now"], *arguments)

    return functools.partial(function, sizes), lambda: sizes.update(now=jnp.array([2.0]))


def a_default(use):
    def function(*arguments, sizes=[jnp.ones(1)]):  # noqa: B006
        return use(sizes[0], *arguments)

    return function, lambda: function.__kwdefaults__["sizes"].__setitem__(0, jnp.array([2.0]))


def an_array_in_place(use):
    size = np.ones(1)
    return lambda *a: use(size, *a), lambda: size.fill(2.0)


def a_list_in_place(use):
    size = [1.0]
    return lambda *a: use(np.array(size), *a), lambda: size.__setitem__(0, 2.0)


CALLED = None


def a_function_that_it_calls(use):
    sizes = np.ones(1), np.full(1, 2.0)

    def rebind(k):
        global CALLED
        CALLED = lambda: sizes[k]

    rebind(0)
    return lambda *a: use(CALLED(), *a), lambda: rebind(1)


class Sized(eqx.Module):
    size: jax.Array | np.ndarray
    use: object = eqx.field(static=True)

    def __call__(self, *arguments):
        return self.use(self.size, *arguments)


def an_equinox_module(use):
    size = np.ones(1)
    return Sized(size, use), lambda: size.fill(2.0)


def another_equinox_module(use):
    return Sized(jnp.ones(1), use), lambda: Sized(jnp.array([2.0]), use)


def another_lambda(use):
    sizes = jnp.ones(1), jnp.array([2.0])
    return lambda *a: use(sizes[0], *a), lambda: lambda *a: use(sizes[1], *a)


WAYS = [
    a_global, a_closure_cell, an_attribute, a_method, an_instance, a_partial, a_default, an_array_in_place,
    a_list_in_place, a_function_that_it_calls, an_equinox_module, another_equinox_module, another_lambda,
]  # fmt: skip
FEW = [a_global, an_array_in_place, another_equinox_module]  # of functions that are told, that are not, with arrays


# Entry points: each takes a function that `use`s a size, and gives what asks for a result.

BLOCK, PULSE = rk.Block(0.2, 2.0), rk.SinePulse(0.28, 1.2)
ENGINE = rk.Diffrax(diffrax.Bosh3(), rtol=1e-4)  # of few stages
SHORT = {"model": rk.Linear(), "engine": rk.Series(order=6), "progress": False}  # compiles in half the time


def sine(x, block):
    return jnp.sin(block.alpha - x)


def dissipation(size, x, v, block):
    return 0.2 * jnp.sum(jnp.asarray(size)) * v


def pulse(size, amplitude, duration):
    return rk.HalfSinePulse(jnp.sum(jnp.asarray(size)) * amplitude, duration)


def of_model(answer):
    def entry(function):
        model = rk.models.Equation(sine, None, function)
        return lambda: answer(model)

    return entry, dissipation


def of_pulse(answer):
    return (lambda function: lambda: answer(function)), pulse


def region(motion):
    def by_name(amplitude, duration):
        return motion(amplitude, duration)

    seen = rk.inverse.Observations([0.2, 0.25], [2.0, 2.5], ["survived", "toppled"])
    over = {"amplitude": [0.2, 0.4], "duration": [0.3, 0.6]}
    likelihood = rk.inverse.Likelihood(seen, by_name, model=rk.Linear(), engine=rk.Series(order=6))
    return lambda: rk.inverse.feasible_region(likelihood, over, progress=False).log_likelihood


def stripes(model):
    levels = np.linspace(0.2, 0.8, 61)
    found = rk.hazard.simulated_fragility(BLOCK, [PULSE], levels, model, engine=ENGINE, progress=False)
    return found.verdict


def ratios(model):
    found = rk.overturning_map([2.0, 3.0], [1.5, 2.0], model=model, engine=ENGINE, progress=False)
    return found.margin


QUICK = {
    "outcome": of_model(lambda model: rk.outcome(BLOCK, PULSE, model, engine=ENGINE).max_rotation),
    "overturning_map of a pulse": of_pulse(
        lambda f: rk.overturning_map([1.0, 2.0], [1.2, 1.5], pulse=f, **SHORT).rotation_ratio
    ),
    "feasible_region": (region, pulse),
}


SLOW = {
    "simulate": of_model(lambda model: rk.simulate(BLOCK, PULSE, model, engine=ENGINE, samples=9).rotation),
    "simulated_fragility": of_model(stripes),
    "overturning_map of a model": of_model(ratios),
    "rocking_spectrum": of_model(
        lambda m: rk.rocking_spectrum(0.2, PULSE, [3.0, 4.0], model=m, engine=ENGINE, progress=False).margin
    ),
    "sensitivity_map": of_model(
        lambda m: rk.studies.sensitivity_map(
            [0.5], [1.0], model=m, engine=ENGINE, progress=False
        ).sensitivity.margin.value
    ),
    "critical_amplitudes": of_model(
        lambda m: rk.critical_amplitudes(
            BLOCK, PULSE, m, intensity=(1.3, 1.8), derivatives=False, engine=ENGINE, progress=False
        ).value
    ),
    "fit_history": of_model(
        lambda m: rk.inverse.fit_history(
            np.linspace(0, 1, 20), np.linspace(0.1, 0.05, 20), BLOCK, model=m, parameters=["p"], starts=1,
            engine=ENGINE,
        ).rotation
    ),
}  # fmt: skip


@functools.cache
def fresh(name):
    """Results for both sizes by a function that holds its size as a parameter: nothing changes behind anyone's back."""
    entry, use = (QUICK | SLOW)[name]
    return [np.asarray(entry(Sized(jnp.array([size]), use))()) for size in (1.0, 2.0)]


@pytest.mark.parametrize("name, way", [
    *(pytest.param(name, way, id=f"{name}-{way.__name__}") for name in QUICK for way in WAYS),
    *(pytest.param(name, way, id=f"{name}-{way.__name__}", marks=pytest.mark.slow) for name in SLOW for way in FEW),
])  # fmt: skip
def test_a_changed_function_gives_a_changed_answer(name, way):
    """Check all ways of changing a function for the first entry points; all entries use `current_function`."""
    entry, use = (QUICK | SLOW)[name]
    expected = fresh(name)
    function, change = way(use)
    ask = entry(function)
    first = np.asarray(ask())
    another = change()
    ask = entry(another) if another is not None else ask
    second = np.asarray(ask())
    np.testing.assert_allclose(first, expected[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(second, expected[1], rtol=1e-9, atol=1e-12)
    assert (first.shape != second.shape) or (first != second).any()


NUMBER = jax.ShapeDtypeStruct((), np.dtype(float))


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_programs_are_equal_and_arrays_are_not(way):
    """Check for any two sizes that programs are equal and arrays are not, so that nothing is compiled again."""
    function, change = way(lambda size, x: jnp.sum(jnp.asarray(size)) * jnp.cos(x))
    before, same = (trace_function(function, NUMBER) for _ in range(2))
    after = trace_function(change() or function, NUMBER)
    assert jax.tree.structure(before) == jax.tree.structure(same) == jax.tree.structure(after)
    for found, size in ((before, 1.0), (same, 1.0), (after, 2.0)):
        assert float(jax.jit(lambda f: f(0.5))(found)) == pytest.approx(size * np.cos(0.5), rel=1e-15)


def test_numbers_are_part_of_the_program():
    size = 0.1
    function = lambda x: size * x
    before = trace_function(function, NUMBER)
    size = np.nextafter(0.1, 1)
    after = trace_function(function, NUMBER)
    assert jax.tree.structure(before) != jax.tree.structure(after)
    assert float(before(1.0)) != float(after(1.0)) == size


def test_what_was_traced_stays_as_it_was():
    """Also what it has captured of NumPy, and if it is a single number, or held by a function that JAX has compiled."""
    array, number = np.ones(3), np.array(2.0)
    compiled = jax.jit(lambda x: jnp.sum(array) * x)
    found = trace_function(lambda x: array[1:] @ array[1:] * x + number * x + jnp.sum(array) * x, NUMBER)
    inner = trace_function(lambda x: compiled(x), NUMBER)
    array[...], number[...] = 7.0, 9.0
    assert float(found(1.0)) == 2.0 + 2.0 + 3.0
    assert float(inner(1.0)) == 3.0


def test_other_rules_of_derivatives_are_another_program():
    def with_slope(slope):
        @jax.custom_jvp
        def function(x):
            return 2 * x

        function.defjvp(lambda p, t: (function(*p), slope * t[0]))
        return trace_function(function, NUMBER)

    one, same, other = with_slope(1.0), with_slope(1.0), with_slope(3.0)
    assert jax.tree.structure(one) == jax.tree.structure(same) != jax.tree.structure(other)
    assert [float(jax.jit(jax.grad(lambda x, f=f: f(x)))(1.0)) for f in (one, other)] == [1.0, 3.0]


def test_traced_values_are_captured_with_their_derivatives():
    def of(size):
        found = trace_function(lambda x: size * x**2, NUMBER)
        return jax.jit(lambda f, x: f(x))(found, 3.0)

    assert float(jax.grad(of)(2.0)) == 9.0
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(of)))(jnp.arange(3.0)), 9.0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_precision_is_that_of_the_scene(dtype):
    """Python's numbers take it, whatever a function returns; so do arguments."""
    seen = []

    def restoring(x, block):
        seen.append((x.dtype, block.alpha.dtype, block.p.dtype, block.restitution.dtype, x.weak_type))
        return 0.3

    block = rk.Block(*(jnp.asarray(x, dtype) for x in (0.2, 2.0)))
    model = current_model(
        rk.models.Equation(restoring), block, rk.SinePulse(jnp.asarray(0.3, dtype), jnp.asarray(1.0, dtype))
    )
    assert seen == [(dtype,) * 4 + (False,)]
    assert jax.eval_shape(lambda b: model.moments(b).threshold, block).dtype == dtype
    assert len(seen) == 1


@pytest.mark.parametrize("block", [rk.Block(0.2, 2.0), rk.Block(0.2, 2.0, 0.7), AsymmetricBlock(0.2, 0.3, 2.0)])
def test_functions_see_every_kind_of_block(block):
    model = rk.models.Equation(lambda x, b: jnp.sin(b.alpha - x) * b.p / b.restitution)
    found = current_model(model, block)
    for side in block.sides if isinstance(block, AsymmetricBlock) else (block,):
        expected = np.sin(np.asarray(side.alpha)) * np.asarray(side.p) / np.asarray(side.restitution)
        for each in (found, model):
            at_rest = jax.jit(lambda b, each=each: each.moments(b).restoring_at_rest)(side)
            assert float(at_rest) == pytest.approx(float(expected), rel=1e-15)


def test_a_model_that_holds_an_equation():
    """Functions are found wherever they are in a model, and models without any are left alone."""

    class Stiffer(rk.models.AbstractEquation):
        inner: rk.models.Equation

        def moments(self, block):
            return self.inner.moments(block).times(2.0)

        @property
        def is_series(self):
            return False

    model = current_model(Stiffer(rk.models.Equation(sine)), BLOCK)
    assert isinstance(model.inner._acceleration.traced, TracedFunction)
    assert current_model(model, BLOCK) is model
    assert current_model(rk.Housner(), BLOCK) == rk.Housner()


def test_checks_of_a_users_pulse_tell_the_point():
    with pytest.raises(
        ValueError, match=r"`period` must be positive and finite, from 1e-9 to 1e9, but is not at the point \(2, 3\)"
    ):
        rk.overturning_map([3.0], [2.0], pulse=lambda a, t: rk.SinePulse(a, -t), **SHORT)
    rk.overturning_map([3.0], [2.0], pulse=lambda a, t: rk.SinePulse(a, t), **SHORT)


def test_an_equal_function_is_not_compiled_again():
    def run(size):
        held = jnp.array([size])
        return rk.overturning_map([1.0, 2.0], [1.2, 1.5], pulse=lambda a, t: pulse(held, a, t), **SHORT)

    run(1.0), run(2.0)
    before = len(COMPILED)
    run(3.0)
    assert len(COMPILED) == before


# Models that hold arrays, which had been refused: "unhashable type".


class Softer(rk.models.AbstractEquation):
    """A linear block on a softer ground."""

    factors: jax.Array

    def moments(self, block):
        return rk.Linear().moments(block).times(jnp.prod(self.factors))


class SofterMoment(eqx.Module):
    """Housner's, as functions."""

    factors: jax.Array

    def __call__(self, x, v, push, block):
        return -jnp.prod(self.factors) * (jnp.sin(block.alpha - x) + push * jnp.cos(block.alpha - x))


FACTORS = jnp.array([0.5, 1.6])
# The model with its engine, what it is without the factors, and how near they come.
HELD = {
    "series": ({"model": Softer(FACTORS), "engine": SHORT["engine"], "progress": False}, SHORT, 1e-9),
    "functions": (
        {
            "model": rk.models.Equation(acceleration=SofterMoment(FACTORS)),
            "engine": rk.Diffrax(rtol=1e-7),
            "progress": False,
        },
        {"progress": False},
        1e-4,
    ),
}


# A block of another p, in time p t: 0.8 times the acceleration is sqrt(0.8) times the p.
SOFT = float(np.sqrt(0.8))


def soft_map(held, plain):
    found = rk.overturning_map([2.0, 3.0], [1.5, 3.0], **held)
    return found.rotation_ratio, rk.overturning_map(np.array([2.0, 3.0]) / SOFT, [1.5, 3.0], **plain).rotation_ratio


def soft_suite(held, plain):
    levels = [0.25, 0.3, 0.35, 0.4, 0.5]
    softer = rk.Block(0.2, 2.0 * SOFT)
    return (
        rk.hazard.simulated_fragility(block, [PULSE], levels, **settings).verdict
        for block, settings in ((BLOCK, held), (softer, plain))
    )


def soft_critical(held, plain):
    softer = rk.Block(0.2, 2.0 * SOFT)
    return (
        rk.critical_amplitudes(block, PULSE, intensity=(1.3, 1.8), **settings).value
        for block, settings in ((BLOCK, held), (softer, plain))
    )


def soft_sensitivities(held, plain):
    found = rk.studies.sensitivity_map([0.5], [1.0], **held), rk.studies.sensitivity_map([0.5], [SOFT], **plain)
    return (x.sensitivity.max_rotation.elasticity[0, 0] for x in found)


@pytest.mark.parametrize(
    "study, kind",
    [
        (soft_map, "series"),
        (soft_map, "functions"),
        (soft_suite, "series"),
        pytest.param(soft_critical, "series", marks=pytest.mark.slow),
        pytest.param(soft_sensitivities, "series", marks=pytest.mark.slow),
        pytest.param(soft_suite, "functions", marks=pytest.mark.slow),
        pytest.param(soft_critical, "functions", marks=pytest.mark.slow),
        pytest.param(soft_sensitivities, "functions", marks=pytest.mark.slow),
    ],
)
def test_models_that_hold_arrays(study, kind):
    *settings, tolerance = HELD[kind]
    found, expected = study(*settings)
    assert np.size(found) == np.size(expected) > 0
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
