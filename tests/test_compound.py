"""Compound operations: their values, derivatives, programs and types.

The tests also bound the length of programs.
"""

import collections
import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

import jaxrock as rk
from jaxrock.compiler import custom_tangent, lane_function
from jaxrock.compiler.autodiff.jvp_jaxpr import jvp_jaxpr
from jaxrock.compiler.hints import as_dtype, common_type, select, stop_gradient
from jaxrock.compiler.hints.materialize import with_hints
from jaxrock.compiler.primitive import macro
from jaxrock.engines import free_stage
from jaxrock.numerics import elementary, polynomial as polynomials
from jaxrock.numerics.exponential_sums import powers
from jaxrock.numerics.roots import implicit

RNG = np.random.default_rng(7)
NUMBERS = RNG.uniform(0.1, 1.2, 12)

# Name: the operation, its settings, how many numbers it takes.
OPERATIONS = {
    "value": (polynomials.polynomial, {"derivatives": 0}, 6),
    "value of a constant": (polynomials.polynomial, {"derivatives": 2}, 2),
    "third derivative": (polynomials.polynomial, {"derivatives": 3}, 7),
    "derivatives of a short one": (polynomials.polynomial, {"derivatives": 4}, 4),
    "sum of products": (polynomials._products, {}, 10),
    "one product": (polynomials._products, {}, 2),
    "rescaled": (polynomials._rescaled, {}, 5),
    "sign is kept": (polynomials._keeps_sign, {}, 8),
    "fall": (polynomials._fall_bound, {"order": 2}, 6),
    "clear length": (polynomials._clear_length, {}, 3),
    "sine, cosine": (elementary._sine_cosine, {}, 1),
    "sine, cosine of any": (elementary._sine_cosine_of_any, {}, 1),
    "logarithm": (elementary._logarithm, {}, 1),
    "exponential": (elementary._exponential, {}, 1),
    "elliptic integral": (free_stage._carlson_rf, {}, 3),
}
each = pytest.mark.parametrize("operation, settings, count", OPERATIONS.values(), ids=OPERATIONS)


def numbers_for(count):
    """Numbers, some of them negative."""
    return list(NUMBERS[:count] * np.where(np.arange(count) % 3 == 2, -1, 1) ** (count > 3))


def written_of(operation, settings, numbers):
    """The operation's name, and what it consists of as a program."""
    program = jax.make_jaxpr(lambda *x: operation(*x, **settings))(*numbers)
    (equation,) = (e for e in program.jaxpr.eqns if macro.is_macro(e.primitive.name))
    return macro.expand(equation.primitive.name, [x.aval for x in equation.invars], equation.params)


@each
def test_it_is_what_it_consists_of(operation, settings, count):
    """Check that an operation equals its expansion: alone, compiled, and in a batch with shared numbers."""
    numbers, shares = numbers_for(count), np.linspace(0.9, 1.1, 3)
    written = jaxpr_as_fun(written_of(operation, settings, numbers))

    def of(*numbers):
        return operation(*numbers, **settings)

    @jax.jit
    def of_many(numbers):
        found = {}
        for mapped in {0, count - 1, count // 2}:
            many = [shares * x if k == mapped else x for k, x in enumerate(numbers)]
            found[mapped] = jax.vmap(of, in_axes=[0 if k == mapped else None for k in range(count)])(*many)
        nested = jax.vmap(lambda *x: of(*(y * jnp.ones(2) if k else y for k, y in enumerate(x))))
        return found, nested(*(jnp.stack([x, x]) for x in numbers)) if count > 1 else None

    assert len(jax.make_jaxpr(of)(*numbers).jaxpr.eqns) == 1
    alone = jax.jit(lambda *numbers: (of(*numbers), written(*numbers)))
    compiled, expected = alone(*numbers)
    np.testing.assert_allclose(of(*numbers), expected, rtol=1e-15)
    np.testing.assert_allclose(compiled, expected, rtol=1e-15)
    rows, nested = of_many(numbers)
    for mapped, found in rows.items():
        each = [alone(*(share * x if k == mapped else x for k, x in enumerate(numbers)))[0] for share in shares]
        np.testing.assert_allclose(found, np.transpose(each), rtol=1e-15, atol=1e-300)
    if count > 1:
        np.testing.assert_allclose(np.asarray(nested)[:, 1, 1], expected, rtol=1e-15)


@each
def test_it_changes_as_what_it_consists_of(operation, settings, count):
    """Check that derivatives equal those of the expansion: forward, reverse, by some of the numbers, and again."""
    numbers = numbers_for(count)
    program = written_of(operation, settings, numbers)

    def of(*numbers):
        return jnp.stack(operation(*numbers, **settings))

    def plain(*numbers):
        return jnp.stack(jaxpr_as_fun(program)(*numbers))

    if settings == {} and operation in (elementary._logarithm,):  # bits have no derivatives
        plain = lambda x: jnp.log(x)[None]
    chosen = dict.fromkeys([tuple(range(count)), (0,), (count - 1,)])
    derivatives = [jax.jacfwd, jax.jacrev]
    if operation is free_stage._carlson_rf:  # whose loop reverse mode does not go through
        derivatives.remove(jax.jacrev)

    @jax.jit
    def judge(*numbers):
        return jax.jacfwd(plain, range(count))(*numbers), jax.jacfwd(jax.jacfwd(plain))(*numbers)

    @jax.jit
    def found(*numbers):
        alone, rows = {}, {}
        for which in chosen:
            alone[which] = [derivative(of, which)(*numbers) for derivative in derivatives]
            many = [jnp.stack([x, 0.9 * x]) if k in which else x for k, x in enumerate(numbers)]
            rows[which] = jax.vmap(jax.jacfwd(of, which), [0 if k in which else None for k in range(count)])(*many)
        return alone, rows, jax.jacfwd(jax.jacfwd(of))(*numbers)

    alone, rows, second = found(*numbers)
    for which in chosen:
        moved = [0.9 * x if k in which else x for k, x in enumerate(numbers)]
        here, there = (np.stack([judge(*at)[0][k] for k in which]) for at in (numbers, moved))
        for each in alone[which]:
            np.testing.assert_allclose(each, here, rtol=2e-14, atol=1e-14)
        np.testing.assert_allclose(rows[which], np.stack([here, there], axis=1), rtol=2e-14, atol=1e-14)
    np.testing.assert_allclose(second, judge(*numbers)[1], rtol=1e-12, atol=1e-12)


@each
def test_in_single_precision_after_double(operation, settings, count):
    """Integers are longer there: what was written for one is not taken for the other."""
    numbers = [np.float32(x) for x in numbers_for(count)]
    for double in (True, False):
        with jax.enable_x64(double):
            program = jax.make_jaxpr(lambda *x: operation(*x, **settings))(*numbers)
            jax.make_jaxpr(lambda *x, of=program: jvp_jaxpr(of, x, [True] * count, x, None))(*numbers)


@each
def test_machine_code_is_the_same(operation, settings, count):
    call = pytest.importorskip("jaxrock.compiler.llvm.compiled_program", reason="needs llvmlite")
    numbers = numbers_for(count)
    lanes = [np.linspace(0.8, 1.2, 21) * x for x in numbers]

    def of(*numbers):
        return operation(*numbers, **settings)

    plan = call.CompiledProgram(jax.make_jaxpr(of)(*numbers), [False] * count)
    found, expected = jax.jit(lambda lanes: (plan(lanes, threads=1), jax.vmap(of)(*lanes)))(lanes)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)


def test_a_polynomial_is_its_sum():
    """Against 30 digits."""
    mp.mp.dps = 30
    terms, x = RNG.normal(size=9), 0.73
    found = polynomials.jet([jnp.asarray(c) for c in terms], jnp.asarray(x), 3)
    for k in range(4):
        expected = sum(mp.mpf(terms[j]) * math.perm(j, k) * mp.mpf(x) ** (j - k) for j in range(k, 9))
        assert abs(float(found[k]) - expected) < 1e-13 * max(1, abs(expected))
    np.testing.assert_array_equal(polynomials.jet([], jnp.asarray(x), 1), 0.0)


def test_a_choice_is_that_of_numpy():
    def chosen(flag, single, double, first, second):
        pairs = (1.5, single), (double, 1), (first, second), (1.0, 2.0), (flag, False)
        return [
            (select(choice, *pair), jnp.where(choice, *pair)) for pair in pairs for choice in (flag, ~flag, True)
        ], select(jnp.arange(3) > 1, 1.0, jnp.arange(3.0))

    given = np.True_, np.float32(2), np.float64(3), np.int32(1), np.int32(2)
    pairs, several = jax.jit(chosen)(*given)
    assert len(pairs) == 15
    for found, expected in pairs:
        assert (found.dtype, found.weak_type, found.item()) == (expected.dtype, expected.weak_type, expected.item())
    np.testing.assert_array_equal(several, [0, 1, 1])
    alone = select(jnp.asarray(True), jnp.float64(3), 1)
    assert (alone.dtype, alone.weak_type, float(alone)) == (jnp.float64, False, 3.0)


def test_what_is_fixed_has_no_derivatives():
    """Check that a `fixed` value has no derivatives; all of it is one operation."""

    def of(x, y):
        held = stop_gradient({"a": x, "b": (y, jnp.int32(2))})
        return x * held["a"] + held["b"][0]

    assert jax.grad(of, (0, 1))(3.0, 5.0) == (3.0, 0.0)
    np.testing.assert_array_equal(jax.vmap(jax.grad(of), (0, None))(jnp.arange(3.0), 2.0), [0, 1, 2])
    assert str(jax.make_jaxpr(of)(3.0, 5.0)).count("stop_gradient_of_tree") == 1


def squared_slope(value, by, change):
    return 2 * by * change


@pytest.mark.parametrize("checkpoint", [lambda f: f, jax.checkpoint], ids=["kept", "checkpoint"])
def test_given_values_in_a_scan(checkpoint):
    """x^2 three times over, whose square is given: derivatives of three orders, in every nesting and in lanes."""

    @checkpoint
    def step(x, _):
        return custom_tangent(squared_slope, jax.lax.stop_gradient(x**2), x), None

    def of(x):
        return jax.lax.scan(step, x, None, length=3)[0]

    @jax.jit
    def alone(x):
        twice = jax.hessian(of), jax.grad(jax.grad(of)), jax.jacfwd(jax.jacfwd(of))
        return of(x), jax.grad(of)(x), [nested(x) for nested in twice], jax.jacfwd(twice[1])(x)

    @jax.jit
    def in_lanes(x):
        scaled = jax.vmap(
            lambda a: custom_tangent(squared_slope, jax.lax.stop_gradient(x[0] ** 2), a)
        )  # the value is shared
        return jax.vmap(jax.hessian(of))(x), jax.hessian(lambda x: jax.vmap(of)(x).sum())(x), scaled(x)

    value, slope, seconds, third = alone(1.1)
    assert value == pytest.approx(1.1**8) and slope == pytest.approx(8 * 1.1**7)
    assert seconds == pytest.approx([56 * 1.1**6] * 3, rel=1e-14)
    assert third == pytest.approx(336 * 1.1**5, rel=1e-14)
    x = np.linspace(0.5, 1.5, 4)
    each, of_sum, shared = in_lanes(x)
    np.testing.assert_allclose(each, 56 * x**6, rtol=1e-14)
    np.testing.assert_allclose(of_sum, np.diag(56 * x**6), rtol=1e-14)
    np.testing.assert_array_equal(shared, np.full(4, x[0] ** 2))


ASKED = []


def to_cube_root(cube, x):
    ASKED.append(x)
    return (x**3 - cube) / (3 * x**2)


def test_a_root_moves_as_the_implicit_function_does():
    """To third derivatives, in both modes and in lanes; without them nobody computes how far it is."""

    def root(cube):
        return implicit(to_cube_root, jax.lax.stop_gradient(jnp.cbrt(cube)), cube)

    ASKED.clear()
    jax.jit(root)(8.0)
    assert not ASKED
    nested = jax.grad(root), jax.grad(jax.grad(root)), jax.jacfwd(jax.grad(jax.jacfwd(root)))
    cubes = np.array([0.5, 8.0, 30.0])
    for order, derivative in enumerate(nested, 1):
        exact = np.prod(1 / 3 - np.arange(order)) * cubes ** (1 / 3 - order)
        np.testing.assert_allclose(jax.jit(jax.vmap(derivative))(cubes), exact, rtol=1e-13)
    assert ASKED


def test_rules_are_functions_of_modules():
    """Programs tell them by their names, which those within another share."""

    def rule(value, by, change):
        return change

    assert "squared_slope" in str(jax.make_jaxpr(lambda x: custom_tangent(squared_slope, x, x))(1.0))
    with pytest.raises(ValueError, match="must be a function of a module, but is .*rule"):
        custom_tangent(rule, 1.0, 1.0)
    with pytest.raises(ValueError, match="must be a function of a module, but is .*lambda"):
        implicit(lambda by, x: x - by, 1.0, 1.0)


@pytest.mark.parametrize("count", [1, 16, 21])
def test_powers(count):
    """Beside NumPy's, of numbers in lanes, complex ones too; and their slopes."""
    base = np.array([0.0, -0.7, 1.3]) + 1j * np.array([0.0, 0.4, 0.0])
    exponents = np.arange(count)
    np.testing.assert_allclose(powers(base, count), base ** exponents[:, None], rtol=1e-14)
    slopes = jax.jacfwd(lambda x: powers(x, count))(1.3)
    np.testing.assert_allclose(slopes, exponents * 1.3 ** (exponents - 1.0), rtol=1e-14)


def operations_of(jaxpr):
    """Return the names of the operations in a program, with repetition."""
    inner = [
        getattr(part, "jaxpr", part)
        for equation in jaxpr.eqns
        for value in equation.params.values()
        for part in (value if isinstance(value, (tuple, list)) else (value,))
        if hasattr(getattr(part, "jaxpr", part), "eqns")
    ]
    here = collections.Counter(equation.primitive.name for equation in jaxpr.eqns)
    return sum(map(operations_of, inner), here)


def recipes_in(jaxpr):
    """The recipes that a program asks for."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "lane_map":
            yield equation.params["fn"]
        for value in equation.params.values():
            if hasattr(value, "jaxpr"):
                yield from recipes_in(value.jaxpr)


def recipe_in(jaxpr):
    """The first of them."""
    return next(recipes_in(jaxpr))


def test_a_function_of_traced_numbers_keeps_its_kind_of_derivatives():
    """Check that a captured tracer becomes an argument, and that the kind of derivatives stays."""

    def of(a):
        return lane_function(lambda x: a * x**2, mode="jvp")(3.0)

    assert recipe_in(jax.make_jaxpr(of)(2.0).jaxpr).mode == "jvp"
    assert jax.jvp(of, (2.0,), (1.0,))[1] == 9.0


def test_a_few_at_once():
    """By more numbers there is no Jacobian, but the change in one direction."""
    squares = lane_function(lambda x: x**2, mode="jacobian or jvp")
    for size, directions in ((64, 0), (65, 1)):
        x = np.arange(1.0, size + 1)
        asked = jax.make_jaxpr(lambda d, x=x: jax.jvp(squares, (x,), (d,))[1])(x)
        assert recipe_in(asked.jaxpr).directions == directions
        np.testing.assert_array_equal(jax.jvp(squares, (x,), (x,))[1], 2 * x**2)


@pytest.mark.parametrize(
    "motion, most", [(rk.SinePulse(0.5, 1.0), 2500), (rk.example_record(), 2600)], ids=["pulse", "record"]
)
def test_programs_are_small(motion, most):
    """Bound the operations that JAX traces, batches and differentiates of an outcome: a first answer waits for them."""
    asked = jax.make_jaxpr(lambda alpha: rk.outcome(rk.Block(alpha, 2.0), motion))(0.2)
    recipe = recipe_in(asked.jaxpr)
    with with_hints(False):
        assert 500 < operations_of(recipe.program.jaxpr).total() <= most
    for_xla = operations_of(recipe.program.jaxpr)
    assert for_xla["materialize"] and for_xla.total() <= 1.3 * most


@pytest.mark.parametrize("motion", [rk.SinePulse(0.5, 1.0), rk.example_record()], ids=["pulse", "record"])
def test_programs_of_derivatives_of_histories_are_small(motion):
    """XLA gets no step to differentiate, nor the evaluation of one: those are machine code, asked for by name."""

    def misfit(x):
        history = rk.simulate(rk.Block(x[0], x[1], x[2]), x[3] * motion)
        return jnp.sum(history(jnp.linspace(0.0, 1.0, 8))[0] ** 2)

    asked = jax.make_jaxpr(jax.grad(misfit))(jnp.array([0.2, 2.0, 0.9, 1.1]))
    with with_hints(False):
        history = operations_of(recipe_in(asked.jaxpr).program.jaxpr)
    assert history["lane_map"] >= 2  # a step, the end
    assert (operations_of(asked.jaxpr) + history).total() <= 2500


def test_programs_of_slopes_by_all_samples_are_small():
    """Nor the slopes of a step, nor the free stage; and what follows a block stands there once, however long it is."""
    record = rk.example_record()
    margin = jax.grad(lambda samples: rk.outcome(rk.Block(0.2, 2.0), rk.Record(samples, record.dt)).margin)
    _, pulled_back = recipes_in(jax.make_jaxpr(margin)(record.samples).jaxpr)
    with with_hints(False):
        found = operations_of(pulled_back.program.jaxpr)
    assert (
        found["lane_map"] + found["single_jacobian"] == 4
    )  # steps, once more where slopes are wanted; slopes; the end
    assert found.total() <= 1300


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_logarithms_to_three_units_of_rounding(precision):
    """Beside 40 digits, from 1/2 to 4."""
    x = np.linspace(0.5, 4.0, 4001).astype(precision)
    found = np.asarray(jax.jit(elementary.logarithm)(jnp.asarray(x)))
    with mp.workdps(40):
        errors = [float(abs(mp.mpf(float(value)) - mp.log(float(at)))) for value, at in zip(found, x)]
    assert np.all(errors <= 3 * np.spacing(np.abs(found)))


def test_exponentials_in_single_precision():
    """Where ln 2 is taken off many times."""
    x = np.linspace(-87.0, 88.0, 20_001).astype(np.float32)
    found, expected = np.asarray(jax.jit(elementary.exponential)(jnp.asarray(x))), np.exp(x.astype(float))
    assert np.all(np.abs(found - expected) <= 1.5 * np.spacing(expected.astype(np.float32)))


KINDS = {
    "as it is": lambda x: x,
    "double": lambda x: x.astype(jnp.float64),
    "single": lambda x: x.astype(jnp.float32),
    "whole": lambda x: x.astype(jnp.int32),
    "flag": lambda x: x > 0,
    "complex": lambda x: x + 1j,
    "weak": lambda x: jnp.asarray(2.5),
    "list": lambda x: jnp.stack([x, x]),
    "of Python": lambda x: 2.5,
    "whole of Python": lambda x: 3,
    "flag of Python": lambda x: True,
    "of NumPy": lambda x: np.float64(2.5),
    "single of NumPy": lambda x: np.float32(2.5),
}


@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_types_are_those_of_jax(first, second):
    """Traced or not: type, weakness and shape."""

    def check(x):
        one, other = KINDS[first](x), KINDS[second](x)
        dtype = common_type(one, other)
        assert dtype == jnp.result_type(one, other)
        if dtype.kind == "f":
            for value in (one, other):
                ours, theirs = jax.typeof(as_dtype(value, dtype)), jax.typeof(jnp.asarray(value, dtype))
                assert (ours.dtype, ours.shape, ours.weak_type) == (theirs.dtype, theirs.shape, theirs.weak_type)
        return x

    for number in (jnp.asarray(0.7), jnp.float64(0.7)):  # weak, and not
        check(number)
        jax.jit(check).trace(number)


def test_within_shard_map():
    """Check numbers that differ along a mesh, beside numbers that do not."""
    x = np.linspace(0.1, 0.4, 4)
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("parts",))
    every = jax.sharding.PartitionSpec("parts")

    def of(x):
        return polynomials.polynomial(x, jnp.asarray(2.0), jnp.asarray(3.0), derivatives=1)[0]

    for function in (of, jax.vmap(jax.grad(lambda x: of(x) ** 2))):
        dealt = jax.shard_map(function, mesh=mesh, in_specs=every, out_specs=every)
        np.testing.assert_allclose(jax.jit(dealt)(x), function(x), rtol=1e-15)
        np.testing.assert_allclose(dealt(x), function(x), rtol=1e-15)
