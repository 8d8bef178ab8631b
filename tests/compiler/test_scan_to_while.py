"""Loops of a known number of turns, of which JAX makes scans: the same numbers and derivatives as of a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxpr_as_fun

from jaxrock.compiler.jaxpr.scan_to_while import scan_to_while


def powers(x, y):
    """Sums of y^k x^k, by a loop."""
    return lax.fori_loop(0, 5, lambda k, total: total + (x * y) ** k, 0.0 * x)


def nested(x, y):
    return lax.fori_loop(0, 3, lambda k, total: total * powers(x + k, y), y)


def in_a_case(x, y):
    return lax.cond(x > 0, lambda: powers(x, y), lambda: y)


def in_a_loop(x, y):
    return lax.while_loop(lambda carry: carry[0] < 3, lambda carry: (carry[0] + 1, powers(carry[1], y)), (0, x))[1]


def in_a_call(x, y):
    return jax.jit(powers)(x, y) + powers(y, x)


def beside_a_solve(x, y):
    """Solve linear equations: the operation holds its programs in a named tuple."""
    return jnp.linalg.solve(jnp.array([[2.0, x], [x, 3.0]]), jnp.array([y, 1.0]))[0] * powers(x, y)


def that_returns_what_it_is_given(x, y):
    x, unchanged, total = lax.fori_loop(0, 4, lambda k, carry: (carry[0], carry[1], carry[2] + carry[1]), (x, y, 1.0))
    return x * unchanged + lax.fori_loop(0, 0, lambda k, total: total + x, total)


def of_rows(x, y):
    """Check that loops that take or make rows stay scans."""
    return lax.scan(lambda total, row: (total + row * x, total), y, jnp.arange(4.0))[1][3]


FUNCTIONS = (powers, nested, in_a_case, in_a_loop, in_a_call, beside_a_solve, that_returns_what_it_is_given, of_rows)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_loops_are_what_scans_are(function):
    program = scan_to_while(jax.make_jaxpr(function)(0.3, 0.7))
    assert ("scan" in str(program)) == (function is of_rows)
    found = lambda *point: jaxpr_as_fun(program)(*point)[0]
    both = jax.jit(lambda *point: [(f(*point), jax.jacfwd(f)(*point)) for f in (found, function)])
    for point in ((0.3, 0.7), (-0.4, 1.1)):
        (value, slope), (expected, expected_slope) = jax.device_get(both(*point))
        np.testing.assert_array_equal(value, expected)
        np.testing.assert_allclose(slope, expected_slope, rtol=1e-14)


def test_a_program_without_is_left():
    program = jax.make_jaxpr(lambda x: jnp.sin(x) + lax.while_loop(lambda x: x < 3, lambda x: x + 1, x))(0.3)
    assert scan_to_while(program) is program
