"""Forward mode of whole programs, beside JAX's own: `jax.jvp`, one direction after the other."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxrock.compiler import custom_tangent
from jaxrock.compiler.autodiff.jvp_jaxpr import jvp_jaxpr
from jaxrock.compiler.autodiff.jvp_rules import JVP_RULES, MOVED, OF_SOME, STILL
from jaxrock.compiler.hints import materialize, opaque_one, stop_gradient
from jaxrock.numerics.elementary import exponential, logarithm, sine_cosine
from jaxrock.numerics.polynomial import fall_bound, jet, sum_of_products

X, Y = 0.37, 1.9
LIST = np.array([0.3, -0.7, 1.1])


@jax.custom_jvp
def _counted(x):
    """A number, and an integer that is another where the number changes."""
    return x, jnp.int32(0)


@_counted.defjvp
def _(values, changes):
    (x,), (d,) = values, changes
    return (x, jnp.int32(1)), (2 * d, np.zeros((), jax.dtypes.float0))


def _tripled(_, __, change):
    return 3 * change


def _doubled_until(x, y):
    return lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + y * y, c[1] * c[0], x), (x, y, 1.0))


def _newest(x, y):
    """Return loop results that depend on the inputs only after some turns of the loop."""
    return lax.while_loop(lambda c: c[0] < 4, lambda c: (c[0] + 1, c[2], c[3], x * y), (0, 1.0, 2.0, 3.0))[1:]


def _nested(x, y):
    def body(c):
        count, z = c
        z = lax.while_loop(lambda c: c[0] < 2, lambda c: (c[0] + 1, jnp.sin(c[1]) * y), (0, z))[1]
        return count + 1, lax.cond(z > 0.2, lambda z: z * x, lambda z: 0.5, z)

    return lax.while_loop(lambda c: c[0] < 3, body, (0, x))[1]


def _beside(x, y):
    """A number that stays zero beside one that moves, in a scan."""
    moved, still = lax.fori_loop(0, 3, lambda k, c: (c[0] * x, c[1] * k), (y, 0.0))
    return moved + still**0.5


def _beside_in_a_loop(x, y):
    def body(c):
        moved, still = lax.fori_loop(0, 3, lambda k, c: (c[0] * x, c[1] * k), c[1:])
        return c[0] + 1, moved, still

    _, moved, still = lax.while_loop(lambda c: c[0] < 2, body, (0, y, 0.0))
    return moved + jnp.sqrt(still)


def _checkpointed(x, y):
    moved, still = jax.checkpoint(lambda x, n: (x * x * y, n * 0.0))(x, 1.0)
    return moved + jnp.sqrt(still)


def _sorted_together(x, y):
    keys, still = lax.sort((jnp.stack([y, x]), jnp.zeros(2)), num_keys=1)
    return keys, jnp.sqrt(still)


# Of two numbers, in a program as JAX traces it.
OF_NUMBERS = {
    "a sum": lambda x, y: x + y - 3.0,
    "a product": lambda x, y: x * y * x,
    "a quotient": lambda x, y: (x / y, 1 / y, y / 3.0),
    "a difference from nothing": lambda x, y: 1.0 - x,
    "the larger": lambda x, y: (jnp.maximum(x, y), jnp.minimum(x, y)),
    "a tie": lambda x, y: (jnp.maximum(x * y, y * x), jnp.minimum(x, 0.37), jnp.abs(x - 0.37)),
    "powers": lambda x, y: (x**2, x**3, x**-1, y**-2, lax.integer_pow(y, 0), lax.square(x)),
    "a power of zero": lambda x, y: (x - 0.37) ** 0 + y,
    "a subnormal divisor": lambda x, y: (x / (stop_gradient(y) * 1e-310), x / 1e-310, y / 5e-324),
    "complex numbers": lambda x, y: jnp.abs(jnp.exp(2j * x) * y),
    "roots": lambda x, y: (jnp.sqrt(x), lax.rsqrt(y), x**0.3),
    "circular functions": lambda x, y: (lax.sin(x), lax.cos(y), lax.tan(x), lax.asin(x), jnp.arctan2(x, y)),
    "exponentials": lambda x, y: (lax.exp(x), lax.log(y), lax.tanh(x), jnp.expm1(x)),
    "a choice": lambda x, y: (jnp.where(x > 0, x, y), jnp.where(x > 0, 2.0, y)),
    "clipped": lambda x, y: jnp.clip(x * y, 0.1, 0.2),
    "without a derivative": lambda x, y: (
        jnp.floor(x) + y, lax.ceil(y), lax.round(x), stop_gradient(x) * y, jnp.sign(x), lax.stop_gradient(x),
    ),
    "not zero times infinity": lambda x, y: (
        stop_gradient(x) * jnp.sqrt(y * 0.0 + 1.0) + jnp.where(y > 0, 0.0, stop_gradient(y))
    ),
    "a smaller type": lambda x, y: (x.astype(jnp.float32).astype(x.dtype) * y, (x * 9).astype(jnp.int32) * y),
    "lists": lambda x, y: jnp.stack([x, y, x * y])[1:] * jnp.concatenate([jnp.array([2.0]), x[None]]),
    "one of a list": lambda x, y: (jnp.stack([x, y])[0], jnp.stack([x, x, y]).sum(), jnp.arange(3.0)[1] * x),
    "a list by a number": lambda x, y: (y * LIST, LIST / y, x - LIST, jnp.maximum(x, LIST), (x * LIST).reshape(3, 1)),
    "sorted": lambda x, y: jnp.sort(jnp.stack([y, x, x * y])),
    "a function within": jax.jit(lambda x, y: jax.jit(lambda a, b: a * b)(x, y) + 1),
    "a loop": _doubled_until,
    "a loop that is late": _newest,
    "loops within": _nested,
    "loops side by side": lambda x, y: jax.vmap(lambda x: lax.while_loop(lambda x: x < 3, lambda x: x * 2 * y, x))(
        jnp.stack([x, 3 * x])
    ),
    "zero beside what moves": _beside,
    "zero beside what moves in a loop": _beside_in_a_loop,
    "zero beside what moves in a checkpoint": _checkpointed,
    "sorted with others": _sorted_together,
    "one of many by flags": lambda x, y: jnp.where(jnp.arange(3) > 0, x * LIST, y),
    "a case without a change": lambda x, y: lax.cond(x > 1, lambda x: x * y, lambda x: 1.0, x),
    "one of three": lambda x, y: lax.switch(jnp.int32(x * 3), [lambda x: x, lambda x: x * x, lambda x: 1.0], y),
    "a scan": lambda x, y: lax.scan(lambda c, a: (c * a + x, c), y, jnp.arange(3.0)),
    "a rule that tells integers": lambda x, y: _counted(x * y)[0] * jnp.array([1.0, 10.0])[_counted(x)[1]],
    "within a function only integers": lambda x, y: y * jnp.array([1.0, 10.0])[jax.jit(lambda x: _counted(x)[1])(x)],
    "given by others": lambda x, y: (
        custom_tangent(_tripled, x, y), y + jnp.sqrt(custom_tangent(_tripled, x * 0.0, stop_gradient(x))),
    ),
    "kept for XLA": lambda x, y: (materialize(x, y) * y, y + jnp.sqrt(materialize(x * 0.0, y)), opaque_one(y) + x),
    "a rule": lambda x, y: jax.nn.relu(x) * jax.nn.silu(y),
    "operations of many": lambda x, y: (
        jet([x, y, x * y], y, 2), sum_of_products([x, y, 1.0 * x], [y, 2.0 * y, y]), *sine_cosine(x), logarithm(y),
    ),
    "operations of many without a rule": lambda x, y: (exponential(x), fall_bound([x, -y, x, y], x, 1, y)),
}  # fmt: skip


def told(function, *numbers):
    return jax.make_jaxpr(lambda *numbers: jax.tree.leaves(function(*numbers)))(*numbers)


def expected(function, numbers, moves, directions):
    """Values, and their changes in every direction, by JAX."""

    def of_moving(*own):
        rest = iter(own)
        return jax.tree.leaves(function(*(next(rest) if move else x for x, move in zip(numbers, moves))))

    moving = [x for x, move in zip(numbers, moves) if move]
    values, changes = jax.lax.map(lambda d: jax.jvp(of_moving, moving, d), [jnp.asarray(d) for d in directions])
    return [x[0] for x in values], changes


MOVES = [(True, True), (True, False), (False, True)]


@functools.cache
def found_and_expected(case):
    """Return found and expected values and derivatives for each of `MOVES`: in three directions at once and in one.

    All are in one program.
    """
    function, directions = OF_NUMBERS[case], np.array([[1.0, 0.3, 0.0], [0.0, -2.0, 1.0]])
    program = told(function, np.float64(X), np.float64(Y))

    def of(moves, numbers, directions):
        every = [d for d, move in zip(directions, moves) if move]
        alone = jvp_jaxpr(program, numbers, moves, [d[1] for d in every], None)
        return expected(function, numbers, moves, every), jvp_jaxpr(program, numbers, moves, every, 3), alone

    all_moves = jax.jit(lambda *given: {str(moves): of(moves, *given) for moves in MOVES})
    return jax.tree.map(np.asarray, all_moves((np.float64(X), np.float64(Y)), directions))


@pytest.mark.parametrize("moves", MOVES, ids=str)
@pytest.mark.parametrize("case", OF_NUMBERS)
def test_beside_jax(case, moves):
    """In three directions at once, and in one alone."""
    (values, changes), (found, moved), (alone, moved_alone) = found_and_expected(case)[str(moves)]
    for k, (value, change) in enumerate(zip(values, changes, strict=True)):
        np.testing.assert_allclose(found[k], value, rtol=1e-14)
        np.testing.assert_allclose(alone[k], value, rtol=1e-14)
        np.testing.assert_allclose(moved[k], change, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(moved_alone[k], change[1], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize(
    "case", ["a product", "a quotient", "a list by a number", "loops within", "operations of many"]
)
def test_twice(case):
    """Differentiate a program that was itself made by forward mode: second derivatives are those of JAX."""
    function, moves = OF_NUMBERS[case], (True, True)
    unit = [np.array([1.0, 0.0]), np.array([0.0, 1.0])]
    once = told(lambda *x: jvp_jaxpr(told(function, *x), x, moves, unit, 2), np.float64(X), np.float64(Y))

    @jax.jit
    def both(numbers, first):
        by_jax = functools.partial(expected, function, moves=moves, directions=unit)
        exact = jax.jvp(lambda *x: by_jax(x), numbers, first)[1]
        return jvp_jaxpr(once, numbers, moves, list(first), None)[1], jax.tree.leaves(exact)

    found, exact = both((np.float64(X), np.float64(Y)), (np.float64(1.0), np.float64(0.0)))
    for own, change in zip(found, exact, strict=True):
        np.testing.assert_allclose(own, change, rtol=1e-12, atol=1e-14)


def test_functions_within_are_written_once():
    """Each calls the one below twice: two to the tenth, if written out."""
    function = lambda x, y: jnp.sin(x) * y  # noqa: E731
    for _ in range(10):
        function = jax.jit(lambda x, y, below=function: below(below(x, y), y))
    numbers = jnp.asarray(X), jnp.asarray(Y)
    program, count = told(function, *numbers), []

    def counted(jaxpr, seen):
        for equation in jaxpr.eqns:
            count.append(1)
            inner = equation.params.get("jaxpr")
            if inner is not None and id(inner.jaxpr) not in seen:
                seen.add(id(inner.jaxpr))
                counted(inner.jaxpr, seen)

    counted(told(lambda *x: jvp_jaxpr(program, x, (True, True), x, None), *numbers).jaxpr, set())
    assert len(count) < 400


def test_every_rule_is_asked():
    """The cases above have all operations of the tables."""
    names = set()
    for function in OF_NUMBERS.values():
        names |= {equation.primitive.name for equation in told(function, X * 1.0, Y * 1.0).eqns}
    # Operations that JAX itself makes when it differentiates, and copies.
    assert {*JVP_RULES, *MOVED, *OF_SOME, *STILL} <= names | {"add_any", "copy"}
