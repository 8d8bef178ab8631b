"""Machine code for many lanes at once does what JAX does for each."""

import ctypes
import functools
import itertools
import logging
import platform
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

native = pytest.importorskip("jaxrock.compiler.llvm.compiled_program", reason="needs llvmlite")
jit = pytest.importorskip("jaxrock.compiler.llvm.jit", reason="needs llvmlite")

import diffrax  # noqa: E402
import equinox as eqx  # noqa: E402
import equinox.internal as eqxi  # noqa: E402
from llvmlite import binding, ir  # noqa: E402

import jaxrock as rk  # noqa: E402
from jaxrock.closed_form import single_lobe  # noqa: E402
from jaxrock.compiler import lane_function, xla_ffi  # noqa: E402
from jaxrock.compiler.hints import divergent  # noqa: E402
from jaxrock.compiler.jaxpr.form_fma import form_fma  # noqa: E402
from jaxrock.compiler.jaxpr.inline_and_fold import inline_and_fold  # noqa: E402
from jaxrock.compiler.jaxpr.traverse import programs_of  # noqa: E402
from jaxrock.compiler.llvm import kernels  # noqa: E402
from jaxrock.compiler.llvm.builder import Builder  # noqa: E402
from jaxrock.compiler.llvm.memory_arrays import Memory, _one_of_two  # noqa: E402
from jaxrock.compiler.llvm.operations import Unsupported  # noqa: E402
from jaxrock.compiler.primitive import lane_function as lane_functions, lanes as lane_programs  # noqa: E402
from jaxrock.numerics.derivatives_of import with_derivatives_of  # noqa: E402

NUMBERS = np.array([0.0, -0.0, 1.0, -1.5, 2.5, 3.5, 1e-300, 1e300, -7.3, np.inf, -np.inf, np.nan, 0.1])
OTHERS = np.roll(NUMBERS, 5)
WHOLE = np.array([0, 1, -1, 7, -7, 100, 2**31 - 1, -(2**31), 5, 6, 8, 9, 10], np.int32)


def planned(function, leaves, shared, refilled=False, count=None, threads=1, lanes=None):
    """`function(leaves)` of many lanes, in machine code, to be called with such leaves."""
    like = [jax.ShapeDtypeStruct(x.shape if same else x.shape[1:], x.dtype) for x, same in zip(leaves, shared)]
    plan = native.CompiledProgram(jax.make_jaxpr(function)(like), shared, refilled, lanes=lanes)
    return jax.jit(lambda *leaves: plan(list(leaves), threads, count))


def run(function, leaves, *more, **words):
    """`function(leaves)` of many lanes, in machine code."""
    return planned(function, leaves, *more, **words)(*leaves)


def both(function, *values, shared=()):
    """Results by machine code, and by JAX."""
    values = [np.asarray(v) for v in values]
    flags = [i in shared for i in range(len(values))]
    found = run(lambda leaves: function(*leaves), values, flags)
    axes = [None if flag else 0 for flag in flags]
    return jax.device_get((found, jax.jit(jax.vmap(lambda *v: function(*v), in_axes=axes))(*values)))


def same(found, expected, rtol=0.0):
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=0)
    if rtol == 0 and found.dtype.kind == "f":
        zero = found == 0
        np.testing.assert_array_equal(np.signbit(found[zero]), np.signbit(expected[zero]))


def agree(function, *values, shared=(), rtol=0.0):
    for found, expected in zip(*both(function, *values, shared=shared), strict=True):
        same(found, expected, rtol)


def of_shared(leaves):
    """Numbers, and a long list that a loop changes: that is XLA's."""
    alpha, a, values = leaves
    widest = jax.lax.fori_loop(0, 3, lambda k, x: jnp.maximum(x, jnp.roll(x, -k)), values * alpha)
    return [jnp.sin(alpha) * a + jnp.sqrt(alpha) / (1 + alpha) + widest[3], jnp.cos(alpha)]


def test_what_all_share_is_computed_once_in_a_lane(caplog, monkeypatch):
    """Check that values shared by all lanes are computed once, in a lane, to the bit.

    If machine code lacks an operation of theirs after all, XLA computes them.
    """
    alpha, a, values = np.float64(0.3), np.arange(20.0), np.sin(np.arange(100.0))
    found = run(of_shared, [alpha, a, values], [True, False, True])
    own = run(of_shared, [np.full(20, alpha), a, values], [False, False, True])
    np.testing.assert_array_equal(found, own)

    def refuses(*given, alone):
        raise Unsupported("nothing")

    plain_emit = kernels.emit
    monkeypatch.setattr(
        native, "emit", lambda *given, alone=False: (refuses if alone else plain_emit)(*given, alone=alone)
    )
    with caplog.at_level(logging.DEBUG, "jaxrock"):
        left = run(of_shared, [alpha, a, values], [True, False, True])
    np.testing.assert_allclose(left, own, rtol=1e-15)
    assert "what all lanes share is left to XLA: nothing" in caplog.text


def test_lists_in_order():
    values = np.stack([np.roll(np.array([0.5, -np.inf, np.nan, 3.0, -2.0, np.inf, 3.0]), k) for k in range(7)])
    agree(lambda x: [jnp.sort(x)], values)
    agree(lambda x: [jnp.sort(x)], np.arange(24, dtype=np.int32).reshape(6, 4)[:, ::-1] % 7)


FUSED = {
    "a sum": (lambda x, y, z: x * y + z, 1),
    "a sum before": (lambda x, y, z: z + x * y, 1),
    "less a number": (lambda x, y, z: x * y - z, 1),
    "less a product": (lambda x, y, z: z - x * y, 1),
    "two products": (lambda x, y, z: x * y + y * z, 1),
    "a square": (lambda x, y, z: jax.lax.square(x) + z**2, 1),
    "a few": (lambda x, y, z: jnp.sum(jnp.stack([x, y]) * z - jnp.stack([y, z])), 1),
    "in a loop": (lambda x, y, z: jax.lax.fori_loop(0, 5, lambda _, s: s * x + z, y), 1),
    "of use elsewhere": (lambda x, y, z: (x * y + z) / (2.0 + jnp.abs(x * y)), 1),
    "used twice": (lambda x, y, z: (p := x * y, (p + z) * jnp.cos(p))[1], 0),
    "a result": (lambda x, y, z: jnp.stack([p := x * y, p + z])[0], 0),
    "whole numbers": (lambda x, y, z: (jnp.int32(9 * x) * jnp.int32(9 * y) + 4) * z, 0),
}


@pytest.mark.parametrize("name", FUSED)
def test_products_that_are_added_to_something(name):
    """Check products that are added: with and without fusion in machine code, as in XLA, and with signs of zeros."""
    function, count = FUSED[name]
    values = np.random.default_rng(4).normal(size=(3, 20))
    values[:, -8:] = np.array(list(itertools.product([0.0, -0.0], repeat=3))).T
    program = form_fma(jax.make_jaxpr(lambda *v: [function(*v)])(*values[:, 0]))

    def number_of(jaxpr):
        here = sum(equation.primitive.name == "macro_multiply_add" for equation in jaxpr.eqns)
        return here + sum(map(number_of, (inner for equation in jaxpr.eqns for inner in programs_of(equation))))

    assert number_of(program.jaxpr) == count
    by_xla = jax.jit(jax.vmap(jax.extend.core.jaxpr_as_fun(program)))(*values)[0]
    by_machine, expected = (x[0] for x in both(lambda *v: [function(*v)], *values))
    for found in (by_xla, by_machine):
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)
        if name in ("a sum", "a sum before", "less a number", "less a product"):
            np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))


def test_they_are_rounded_once():
    """Where the processor does so."""
    x, y, z = np.full((3, 9), [[1 + 2.0**-30], [1 - 2.0**-30], [-1.0]])
    (found,) = run(lambda leaves: [leaves[0] * leaves[1] + leaves[2]], [x, y, z], [False] * 3)
    is_arm = platform.machine().lower() in ("arm64", "aarch64")
    once = is_arm or binding.get_host_cpu_features().get("fma", False)
    np.testing.assert_array_equal(found, -(2.0**-60) if once else 0.0)


def test_one_of_two_long_lists():
    """Check a choice between two long lists, which may change from turn to turn, as may the results of a loop."""

    def function(x, here, there):
        def turn(carry):
            k, sums = carry
            flag = jnp.sin(5 * x + k) < 0.2
            chosen = jax.lax.select_n(flag, there, here)
            again = jax.lax.select_n(x > 0, chosen, there)
            return k + 1, sums + chosen[k] * x + again[2 * k]

        return [jax.lax.while_loop(lambda carry: carry[0] < 9, turn, (jnp.int32(0), x))[1]]

    x, lists = np.linspace(-1, 1, 33), np.random.default_rng(1).normal(size=(2, 33, 20))
    agree(function, x, lists[0, 0], lists[1, 0], shared=(1, 2), rtol=1e-13)
    agree(function, x, *lists, rtol=1e-13)
    agree(function, x, lists[0], lists[1, 0], shared=(2,), rtol=1e-13)
    place = ir.Constant(ir.IntType(64).as_pointer(), None)
    with pytest.raises(Unsupported, match="other shapes"):
        _one_of_two(None, None, *(Memory(place, size, None) for size in (9, 8)))


def test_a_number_of_a_few():
    agree(lambda i, x: [x[i], jax.lax.clamp(-0.5, x[0], 0.5)], np.array([-9, 0, 1, 2, 9]), np.eye(5, 3) - 0.7)


def test_polynomials_of_jax():
    """Single operations since JAX 0.12, of a name that one of ours had."""

    def horner(x, coefficients):
        return functools.reduce(lambda found, each: found * x + each, coefficients[::-1])

    of_jax = getattr(jax.lax, "polynomial", horner)
    x, numbers = np.linspace(-2, 2, 9), np.array([1.5, -0.25, 3.0])
    agree(
        lambda x, c: [of_jax(x, [0.5, c[0], c[1], c[2]]), of_jax(x, [c, 2 * c])],
        x,
        np.tile(numbers, (9, 1)),
        rtol=1e-14,
    )


REAL = {
    "sum": lambda x, y: x + y,
    "difference": lambda x, y: x - y,
    "product": lambda x, y: x * y,
    "quotient": lambda x, y: x / y,
    "smaller": jnp.minimum,
    "larger": jnp.maximum,
    "size": lambda x, y: jnp.abs(x),
    "negative": lambda x, y: -x,
    "sign": lambda x, y: jnp.sign(x),
    "root": lambda x, y: jnp.sqrt(jnp.abs(x)),
    "one over a root": lambda x, y: jax.lax.rsqrt(x),
    "powers": lambda x, y: x**2 + y**3,
    "down": lambda x, y: jnp.floor(x),
    "up": lambda x, y: jnp.ceil(x),
    "to even": lambda x, y: jnp.round(x),
    "whole": lambda x, y: x.astype(jnp.int32),
    "clipped": lambda x, y: jnp.clip(x, -2.0, y),
    "chosen": lambda x, y: jnp.where(x < y, x, 2 * y),
    "comparisons": lambda x, y: (x < y) | (x <= y) & (x != y) ^ (x == y) | ~(x >= y) & (x > y),
    "finite": lambda x, y: jnp.isfinite(x),
    "bits": lambda x, y: jax.lax.bitcast_convert_type(x, jnp.int64) >> 52,
    "remainder": lambda x, y: jax.lax.rem(x, y),
}


SINGLE = "sum", "quotient", "smaller", "sign", "to even", "whole", "chosen"


@functools.cache
def of_real_numbers(kind, names):
    """Return, for each operation, results by machine code and by JAX, computed in one program."""
    with np.errstate(over="ignore"):
        x, y = NUMBERS.astype(kind), OTHERS.astype(kind)
    return dict(zip(names, zip(*both(lambda x, y: [REAL[name](x, y) for name in names], x, y))))


@pytest.mark.parametrize("name", REAL)
def test_operations_on_real_numbers(name):
    """Zeros of both signs, infinite, and what is not a number."""
    found, expected = of_real_numbers(np.float64, tuple(REAL))[name]
    same(found, expected, rtol=1e-15 if name in ("powers", "one over a root") else 0.0)


@pytest.mark.parametrize("name", SINGLE)
def test_operations_in_single_precision(name):
    same(*of_real_numbers(np.float32, SINGLE)[name])


def test_operations_on_integers():
    def function(k):
        return [
            k * 3 - 2,
            k.astype(float) / 2,
            k.astype(jnp.int64) + 2**40,
            jnp.sign(k) + jnp.abs(k),
            jnp.minimum(k, 3) + (k > 2),
            k << 2,
        ]

    agree(function, WHOLE)


@pytest.mark.parametrize("bits", [31, 32, 40, -1])
def test_shifts_by_all_bits_and_more(bits):
    """By a number that is known beforehand, and by a lane's own."""
    shifts = jax.lax.shift_left, jax.lax.shift_right_arithmetic
    given = np.full(WHOLE.shape, bits, np.int32)
    agree(lambda k, own: [shift(k, by) for shift in shifts for by in (jnp.int32(bits), own)], WHOLE, given)


def test_logarithms_at_the_ends():
    agree(lambda x: [jnp.log(x)], np.array([0.0, -1.0, np.inf, np.nan, 1.0]))


def test_flags():
    flags = np.array([True, False, True, False])
    agree(lambda a, b: [jnp.maximum(a, b), jnp.minimum(a, b), jnp.max(jnp.stack([a, b]))], flags, ~flags[::-1])


def test_without_double_precision():
    """Numbers in the program are as JAX takes them, not NumPy."""
    with jax.enable_x64(False):
        x = jnp.linspace(0, 2, 9)
        agree(lambda x: [jnp.where(x > 0.5, 2 * x + 1, x * 3), jnp.round(x).astype(int) + 1], x)


FUNCTIONS = {
    "exp": (jnp.exp, np.linspace(0.01, 20, 50)),
    "sin": (jnp.sin, np.linspace(0.01, 20, 50)),
    "cos": (jnp.cos, np.linspace(0.01, 20, 50)),
    "log": (jnp.log, np.linspace(0.01, 20, 50)),
    "tan": (jnp.tan, np.linspace(-1.5, 1.5, 51)),
    "arcsin": (jnp.arcsin, np.concatenate([np.linspace(-1, 1, 81), [1e-300, 1 - 1e-15, 1.1]])),
    "arctan": (jnp.arctan, np.concatenate([np.linspace(-3, 3, 81), [1e-300, -1e9, np.inf, -np.inf, np.nan]])),
    "tanh": (jnp.tanh, np.concatenate([np.linspace(-3, 3, 61), [1e-300, 1e-9, 40.0, -400.0, np.inf]])),
    "sinh": (jnp.sinh, np.concatenate([np.linspace(-3, 3, 60), [1e-300, -1e-9, 19.9, 20.1, 709.9, -np.inf, np.nan]])),
    "cosh": (jnp.cosh, np.concatenate([np.linspace(-3, 3, 61), [1e-300, 40.0, -300.0, 710.0, -np.inf, np.nan]])),
    "log1p": (
        jnp.log1p,
        np.concatenate([np.linspace(-0.999, 3, 61), [1e-300, -1e-9, 1e300, -1.0, -1 + 1e-15, -2.0, np.inf, np.nan]]),
    ),
    "arsinh": (
        jnp.arcsinh,
        np.concatenate([np.linspace(-3, 3, 81), [1e-300, 1e-9, -1e8, 2e9, 1e200, -np.inf, np.nan]]),
    ),
    "artanh": (jnp.arctanh, np.concatenate([np.linspace(-1, 1, 81), [1e-300, 1e-9, 1 - 1e-15, 1.1]])),
}


@functools.cache
def of_functions():
    """Return, for each function, its argument and its result, in one program with equally many lanes for each."""
    lanes = max(x.size for _, x in FUNCTIONS.values())
    functions, given = zip(*((function, np.resize(x, lanes)) for function, x in FUNCTIONS.values()))
    found = run(lambda leaves: [f(x) for f, x in zip(functions, leaves)], given, [False] * len(given))
    return dict(zip(FUNCTIONS, zip(given, found)))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions(name):
    """Our own: to a few units of rounding; NumPy is the judge."""
    x, found = of_functions()[name]
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(found, getattr(np, FUNCTIONS[name][0].__name__)(x), rtol=1e-15, atol=4e-16)


def test_zeros_keep_their_signs():
    zeros = np.array([0.0, -0.0])
    for found in run(lambda leaves: [f(leaves[0]) for f in (jnp.sinh, jnp.log1p)], [zeros], [False]):
        np.testing.assert_array_equal(np.signbit(found), [False, True])


def test_angles_of_points():
    """In all quadrants, on the axes, with zeros of both signs, and far away."""
    x, y = (v.ravel() for v in np.meshgrid(NUMBERS, OTHERS))
    (found,) = map(np.asarray, run(lambda leaves: [jnp.arctan2(*leaves)], [y, x], [False] * 2))
    np.testing.assert_allclose(found, np.arctan2(y, x), rtol=5e-16)
    known = ~np.isnan(found)
    np.testing.assert_array_equal(np.signbit(found[known]), np.signbit(np.arctan2(y, x)[known]))


def test_quotients_of_integers():
    """Also by zero, and one that is too large: the processor would stop there."""
    first, second = (v.ravel() for v in np.meshgrid(WHOLE, WHOLE))
    agree(lambda a, b: [jax.lax.div(a, b), jax.lax.rem(a, b), a % jnp.maximum(jnp.abs(b), 1)], first, second)


def test_what_is_not_known_at_first_is_done_before():
    """Check that XLA first computes, for all lanes, what machine code cannot, and the values that lanes share."""

    def function(x, table):
        start = jnp.sort(jnp.stack([x, -x]))[1] + jnp.cumsum(table)[-1]
        return list(jax.lax.while_loop(lambda s: s[0] < 50, lambda s: (s[0] * 2 + table[2], s[1] + 1), (start, 0)))

    agree(function, np.linspace(-2, 2, 19), np.arange(1.0, 12.0), shared=(1,), rtol=1e-14)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 200])
def test_lanes_are_filled_again(count):
    """Loops of any length, none at all too; lists and small arrays that are a lane's own; flags; what all share."""

    def function(x, own, pair, flag, table):
        turns = jnp.round(jnp.abs(7 * jnp.sin(40 * x))).astype(int)

        def step(s):
            i, total, odd, last = s
            return i + 1, total + x * table[i] + own[i] * pair[0], ~odd, jnp.stack([total, pair[1]])

        i, total, odd, last = jax.lax.while_loop(lambda s: s[0] < turns, step, (0, x, flag, pair * 0))
        return [i, total * 2 + i, odd, last]

    random = np.random.default_rng(0)
    x, own, pair = random.random(count), random.random((count, 9)), random.random((count, 2))
    values = [x, own, pair, x > 0.5, np.arange(9.0)]
    flags = [False] * 4 + [True]
    found = run(lambda leaves: function(*leaves), values, flags, True)
    expected = jax.jit(jax.vmap(function, in_axes=(0, 0, 0, 0, None)))(*values)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14)


def steps_apart(leaves):
    number, turns, own, table = leaves

    def step(s):
        i, number, few, fewer = s

        def frequent():
            return i + 1, (number * 77 + table[number % 9]) % 1009, few, fewer

        def rare():
            return i + 1, (number * 5 + own[number % 11]) % 1009, few + 1, fewer

        def rarer():
            return i + 1, (number + 1) % 1009, few, fewer + number

        def other():
            return jax.lax.cond(divergent(number % 2 == 0), rare, rarer)

        return jax.lax.cond(divergent(number % 7 > 0), frequent, other)

    return jax.lax.while_loop(lambda s: s[0] < turns, step, (jnp.int32(0), number, jnp.int32(0), jnp.int32(0)))


@functools.cache
def drawn_steps(count, draws):
    """Leaves of so many lanes, and what JAX makes of them; who is left at last, and in which slots, is by chance."""
    random, drawn = np.random.default_rng(count), []
    shapes = (count,), (count,), (count, 11), (9,)
    one_by_one = jax.jit(jax.vmap(lambda *x: steps_apart(x), in_axes=(0, 0, 0, None)))
    for _ in range(draws):
        leaves = [random.integers(0, 1009, shape).astype(np.int32) for shape in shapes]
        turns = random.exponential(50, count) * (random.random(count) < 0.7)  # some take no step at all
        leaves[1] = turns.astype(np.int32)
        drawn.append((leaves, jax.device_get(one_by_one(*leaves))))
    return drawn


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count, draws", [(1, 1), (16, 1), (40, 30), (100, 100), (3001, 3)])
def test_lanes_part_where_they_need_other_steps(count, draws, threads):
    """Three kinds of steps, the first of them frequent, with a list of all lanes and one of their own: whole numbers,
    so that every lane has taken its own steps in their order."""
    flags, drawn = [False, False, False, True], drawn_steps(count, draws)
    compiled = planned(lambda leaves: list(steps_apart(leaves)), drawn[0][0], flags, True, threads=threads)
    for leaves, expected in drawn:
        for one, other in zip(compiled(*leaves), expected, strict=True):
            np.testing.assert_array_equal(one, other)
        assert count == 1 or np.min(np.sum(np.asarray(expected[2:]), axis=-1)) > 0


def test_a_step_whose_last_condition_is_known():
    """It has no cases of its own; whatever it is, it is a number and no result of an operation."""

    def function(leaves):
        return [jax.lax.while_loop(lambda x: x < 9, lambda x: jax.lax.cond(True, jnp.exp, jnp.sin, x + 1), leaves[0])]

    x = np.linspace(0, 4, 9)
    expected = jax.vmap(lambda x: function([x]))(x)
    np.testing.assert_allclose(run(function, [x], [False], True)[0], expected[0], rtol=1e-13)


@pytest.mark.parametrize("refilled", [False, True], ids=["in step", "refilled"])
@pytest.mark.parametrize("threads", [2, 7])
def test_threads_share_lanes(threads, refilled):
    """Each lane is done by one of them, once; of those that are not wanted nothing is asked."""

    def function(leaves):
        x, turns = leaves
        found = jax.lax.while_loop(lambda s: s[0] < turns, lambda s: (s[0] + 1, s[1] * 1.01 + x), (0, x))
        return [found[1], found[0]]

    random = np.random.default_rng(0)
    x, turns = random.random(3001), random.integers(0, 2000, 3001)

    given = function, [x, turns], [False, False], refilled
    alone, shared, some = jax.device_get([run(*given), run(*given, threads=threads), run(*given, 1111, threads)])
    for one, other, part in zip(alone, shared, some, strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one[:1111], part[:1111])
    np.testing.assert_array_equal(alone[1], turns)
    for lanes in (2, 4, 8) if threads == 2 else ():  # a vector of any width, and fewer scenes than it holds
        for many in (3001, 1):
            narrow = run(function, [x[:many], turns[:many]], [False, False], refilled, lanes=lanes)
            np.testing.assert_array_equal(narrow[0], alone[0][:many])


def test_functions_of_xla_are_where_its_header_has_them():
    header = Path(jaxlib.__file__).parent / "include" / "xla" / "ffi" / "api" / "c_api.h"
    order = re.findall(r"^ *_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_(\w+)\);", header.read_text(), re.MULTILINE)
    first, size = xla_ffi.Interface.create_error.offset, ctypes.sizeof(ctypes.c_void_p)
    fields = {"create_error": "Error_Create", "destroy_error": "Error_Destroy", "schedule": "ThreadPool_Schedule"}
    for own, name in fields.items():
        assert getattr(xla_ffi.Interface, own).offset == first + size * order.index(name)


@pytest.mark.parametrize("taken", [0, 1])
def test_errors_of_a_pool_without_threads_are_given_back(taken):
    """XLA answers with an error where it takes no task, which is then ours; this thread does what is left."""
    (name,) = native.CompiledProgram(jax.make_jaxpr(lambda x: [x * x])(1.0), [False]).names
    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    handler, error, asked, freed = function(jit._machine()._engine.get_function_address(name)), 4096, [], []

    @function
    def schedule(address):
        task = xla_ffi.Task.from_address(address)
        asked.append(task.struct_size)
        if len(asked) > taken:
            return error
        ctypes.CFUNCTYPE(None, ctypes.c_void_p)(task.task)(task.data)  # in the thread that asks, as XLA may

    @function
    def destroy(address):
        done = xla_ffi.Done.from_address(address)
        freed.append((done.struct_size, done.extension_start, done.error))

    def buffers(*arrays):
        each = [xla_ffi.Buffer(0, None, 0, x.ctypes.data) for x in arrays]
        table = (ctypes.c_void_p * len(each))(*map(ctypes.addressof, each))
        held.extend([each, table])
        return xla_ffi.Buffers(size=len(each), buffers=ctypes.addressof(table))

    held, x, found = [], np.arange(1024.0), np.zeros(1024)
    interface = xla_ffi.Interface(
        destroy_error=ctypes.cast(destroy, ctypes.c_void_p), schedule=ctypes.cast(schedule, ctypes.c_void_p)
    )
    frame = xla_ffi.Frame(api=ctypes.addressof(interface), stage=xla_ffi.EXECUTE, rets=buffers(found))
    frame.args = buffers(np.array([x.size, x.size, 4], np.int32), x)
    assert handler(ctypes.addressof(frame)) is None
    assert len(asked) == taken + 1 and freed == [(24, None, error)]
    np.testing.assert_array_equal(found, x * x)


def test_exponential_less_one():
    x = np.concatenate([np.linspace(-3, 3, 61), [-1e-300, 1e-12, -800.0]])
    found, expected = both(lambda x: [jnp.expm1(x)], x)
    np.testing.assert_allclose(found[0], expected[0], rtol=2e-15)


def test_exponentials_at_the_ends():
    x = np.array([-np.inf, -800.0, -708.0, -1e-300, 0.0, 709.7, 710.0, np.inf, np.nan])
    found = run(lambda leaves: [jnp.exp(leaves[0])], [x], [False])
    with np.errstate(over="ignore"):
        np.testing.assert_allclose(found[0], np.exp(np.where(x == -800, -np.inf, x)), rtol=1e-15)


def test_loops_end_each_in_its_time():
    """Nested; what is done does not go on, and gives no numbers that are not there to the others."""

    def function(x, limit):
        def outer(state):
            i, total = state
            j, part = jax.lax.while_loop(lambda s: s[0] < i, lambda s: (s[0] + 1, s[1] + x / (limit - s[0])), (0, 0.0))
            return i + 1, total + part + j

        return list(jax.lax.while_loop(lambda s: s[0] < limit, outer, (0, 0.0)))

    agree(function, np.linspace(1, 2, 21), np.arange(21) % 7, rtol=1e-15)


def test_cases():
    """Skipped where no lane needs them; a loop inside serves the lanes of its case only."""

    def function(x):
        def grow():
            return jax.lax.while_loop(lambda y: y < 100, lambda y: 2 * y, x), x

        first = jax.lax.cond(x > 3, grow, lambda: (x, 0.0))
        return [*first, jax.lax.cond(x > 50, lambda: jnp.sqrt(x), lambda: jnp.exp(-x))]

    agree(function, np.linspace(0.1, 9, 31), rtol=1e-15)


def test_what_a_loop_does_not_change():
    """Check that loop invariants are computed before the loop, in whichever loop or case; looked-up numbers change."""

    def function(x, table, knots):
        def step(s):
            i, total = s
            more = jax.lax.cond(i > 2, lambda: table[i] * jnp.exp(x), lambda: knots[0] - knots[1] * x)
            return i + 1, total + more * jnp.arctan2(x, 2.0)

        return list(jax.lax.while_loop(lambda s: s[0] < jnp.round(3 * x), step, (0, 0.0)))

    agree(function, np.linspace(0, 2, 19), np.arange(20.0), np.array([1.0, 2.0]), shared=(1, 2), rtol=1e-14)
    own = np.arange(19.0)[:, None] + np.arange(20.0), np.arange(38.0).reshape(19, 2)
    agree(function, np.linspace(0, 2, 19), *own, rtol=1e-14)


def test_small_arrays():
    """Derivatives in several directions at once, through a loop and a case; what moves numbers about."""

    def function(x, pair, table):
        def follow(x, pair):
            def step(s):
                return s[0] + 1, jax.lax.cond(
                    s[1] > 2, lambda: s[1] / pair[0], lambda: s[1] * x + table[s[0]] + pair[1]
                )

            return jax.lax.while_loop(lambda s: s[0] < 9, step, (jnp.round(3 * x).astype(int), x))[1]

        directions = np.eye(3)
        value, slopes = jax.vmap(lambda d: jax.jvp(follow, (x, pair), (d[0], d[1:])), out_axes=(None, 0))(directions)
        square = jnp.concatenate([slopes, slopes[::-1]]).reshape(2, 3).T
        return [
            value,
            slopes,
            jnp.stack([x, value])[0],
            square,
            square.sum(0),
            square.max(),
            jnp.where(x > 1, slopes, 0.0),
        ]

    x = np.linspace(0, 2, 19)
    agree(function, x, np.stack([3 + x, 0.1 * x], 1), np.arange(20.0) / 20, shared=(2,), rtol=1e-14)


def test_axes_of_one_are_repeated():
    agree(lambda x, y: [(x[:, None] * y).sum()], np.arange(8.0).reshape(4, 2), np.arange(16.0).reshape(4, 2, 2))


def test_arrays_of_what_two_loops_change():
    def function(x):
        def outer(a):
            def inner(b):
                return jnp.concatenate([a[None], b[None]]).sum() + 1

            return jax.lax.while_loop(lambda b: b < 9, inner, a) + a * x

        return [jax.lax.while_loop(lambda a: a < 50, outer, x)]

    agree(function, np.linspace(1, 2, 11), rtol=1e-14)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 64])
def test_any_number_of_lanes(count):
    agree(lambda x, y: [x + y, x > y], np.arange(float(count)), 3.0, shared=(1,))


def test_a_list_of_one_lane_is_looked_up_by_all_lanes_of_a_vector():
    """There is no room for a list of each."""
    program = jax.make_jaxpr(lambda x: [x[jnp.round(x[0]).astype(int)]])(np.arange(100.0))
    for alone, begins in ((True, {"0"}), (False, set("01234567"))):
        text = str(kernels.emit(program, [False], 8, "program", alone))
        names = re.findall(r"mul i64 (\S+), 100$", text, re.MULTILINE)
        assert {re.search(rf"{re.escape(name)} = add i64 \S+, (\d+)", text)[1] for name in names} == begins


def test_places_outside_of_a_table():
    agree(lambda i, table: [table[i]], np.array([-30, -1, 0, 9, 10, 300]), np.arange(10.0), shared=(1,))


PLACES = np.array([-9, -1, 0, 1, 2, 3, 9])
TABLES = np.random.default_rng(0).random((7, 4, 3)) - 0.5
ORDERS = np.stack([np.roll(np.array([0.5, -np.inf, np.nan, 3.0, -2.0, 3.0, np.nan]), k) for k in range(7)])

# Of a place, a table of four rows, and a list of seven numbers: all a lane's own.
SMALL_ARRAYS = {
    "a part of a table": lambda i, x, y: jax.lax.dynamic_slice(x, (i, i - 1), (2, 2)),
    "a part that is known": lambda i, x, y: jax.lax.dynamic_slice(x * i, (3, -5), (2, 2)),
    "a row set, or moved inside": lambda i, x, y: jax.lax.dynamic_update_slice(x, x[:1] * 2, (i, 0)),
    "a corner set": lambda i, x, y: jax.lax.dynamic_update_slice(x, x[:2, :2] * 2, (i, i - 1)),
    "a row set, or not": lambda i, x, y: x.at[i].set(x[0] * 2, mode="drop"),
    "a number set": lambda i, x, y: x.at[2, i].set(7.0, mode="clip"),
    "a column": lambda i, x, y: jax.vmap(lambda row: row[i])(x),
    "a choice of four": lambda i, x, y: jax.lax.select_n(jnp.clip(i, 0, 3), *x[:, 0]),
    "where it is least": lambda i, x, y: jnp.argmin(y),
    "where it is largest": lambda i, x, y: jnp.argmax(y[:5]),
    "products": lambda i, x, y: x[0] @ x[1] + x.T @ x + jnp.tensordot(x, x),
    "products of nothing": lambda i, x, y: jnp.concatenate([x[:, :0] @ x[:0], x[:0, :0] @ x[:0]]),
}


@functools.cache
def of_small_arrays():
    """Return results by machine code and by JAX, in a loop, where XLA cannot compute them beforehand."""

    def in_a_loop(*given):
        def once(carry):
            return False, [-v for v in carry[1]], [function(*carry[1]) for function in SMALL_ARRAYS.values()]

        like = jax.eval_shape(lambda: once((True, given, None))[2])
        start = True, list(given), [jnp.zeros(x.shape, x.dtype) for x in like]
        return jax.lax.while_loop(lambda carry: carry[0], once, start)[2]

    return dict(zip(SMALL_ARRAYS, zip(*both(in_a_loop, PLACES, TABLES, ORDERS))))


@pytest.mark.parametrize("name", SMALL_ARRAYS)
def test_small_arrays_as_a_whole(name):
    """At places of each lane's own, also outside of them."""
    found, expected = of_small_arrays()[name]
    same(found, expected, rtol=1e-14 if name == "products" else 0)


def test_next_numbers():
    """Upward, downward, to where it is, from zero and past the largest; below the least normal one all is zero."""
    x, y = (v.ravel() for v in np.meshgrid(np.append(NUMBERS, np.finfo(float).max), NUMBERS))
    (found,) = run(lambda leaves: [jnp.nextafter(*leaves)], [x, y], [False] * 2)
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(found, np.nextafter(x, y))


EXPONENTS = 0.2, -0.75, 3.0, -2.0, 0.0, None
BASES, OWN = (v.ravel() for v in np.meshgrid(np.append(NUMBERS, np.linspace(0.1, 30, 9)), OTHERS))


@functools.cache
def powers():
    def function(leaves):
        x, own = leaves
        return [jax.lax.pow(x, own if power is None else jnp.full_like(x, power)) for power in EXPONENTS]

    return dict(zip(EXPONENTS, run(function, [BASES, OWN], [False] * 2)))


@pytest.mark.parametrize("power", EXPONENTS, ids=str)
def test_powers(power):
    """Compare powers with NumPy, of constant exponents and of exponents of each lane."""
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(powers()[power], np.power(BASES, OWN if power is None else power), rtol=3e-14)


def names_in(program) -> set[str]:
    """Names of all operations of a program, and of the programs in it."""
    inner = [names_in(p) for equation in program.eqns for p in programs_of(equation)]
    return {equation.primitive.name for equation in program.eqns}.union(*inner)


def stages(x):
    """As solvers write them: a table that is looked into, a buffer, a flag that never changes."""
    table = jnp.asarray(np.tri(5, k=-1) / 4)

    def stage(carry):
        i, filled, odd = carry
        value = jnp.sin(x + table[i] @ filled[:])
        return i + 1, eqxi.buffer_at_set(filled, i, value), odd & (x > 0)

    start = jnp.where(eqxi.unvmap_any(jnp.array(False)), 1, 0), jnp.zeros(5), jnp.array(False)
    i, filled, odd = eqxi.while_loop(lambda c: c[0] < 5, stage, start, max_steps=9, kind="lax", buffers=lambda c: c[1])
    return [jnp.where(odd, 0.0, filled[4]), i]


def rows(x):
    """A polynomial, as NumPy's functions write it; a case that is known."""
    return [jnp.polyval(jnp.arange(4.0), x), jax.lax.cond(jnp.arange(3)[1] > 0, jnp.cos, jnp.sin, x)]


def turns(x):
    """A loop with an unknown number of turns: the loop stays, and its invariants are known in it."""

    def turn(carry):
        total, flag, table, odd, late = carry
        total = jnp.where(flag, 0.0, total + table[1])
        return total, flag & (total > 3), jnp.where(flag, -table, table), total > 3, late | odd

    start = x, False, jnp.arange(3.0), False, False
    return list(jax.lax.while_loop(lambda c: c[0] < 5, turn, start))


def zeros_of_both_signs(x):
    """Two cases that only look alike; they are told apart by what they divide."""
    return [1 / jax.lax.select_n(x > 1, jnp.zeros(2), -jnp.zeros(2)) + x]


def bits(x):
    """Bit operations on whole numbers, which are no flags."""
    whole = jnp.arange(5) + 8
    return [jax.lax.reduce_or(whole, [0]) + x, jax.lax.reduce_and(whole, [0]) + x, jnp.any(whole > 3) & (x > 0)]


def no_rows(x):
    """A loop over none at all: what it would have stacked is there, and empty."""
    carry, (rows, flags) = jax.lax.scan(lambda c, row: (c + 1, (c * row, c > 0)), x, jnp.zeros((0, 3)))
    return [carry, jnp.sum(rows) + x, flags]


PROGRAMS = {
    "zeros of both signs": (zeros_of_both_signs, {"select_n"}),
    "bits of whole numbers": (bits, set()),
    "rows of nothing": (no_rows, set()),
    "stages of a solver": (stages, set()),
    "rows of an array": (rows, set()),
    "turns that are not known": (turns, {"while"}),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_in_plain_operations(name):
    """Check that constant folding and the unrolling of loops with a known number of turns change no number."""
    function, left = PROGRAMS[name]
    x = np.linspace(-1, 4, 9)
    program = inline_and_fold(jax.make_jaxpr(jax.jit(function))(1.0))
    kept = names_in(program.jaxpr) & {"while", "scan", "cond", "jit", "select_n", "dynamic_slice", "unvmap_any"}
    assert kept == left
    expected = jax.jit(jax.vmap(function))(x)
    for found, other in zip(jax.jit(jax.vmap(jax.extend.core.jaxpr_as_fun(program)))(x), expected, strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-15)


def test_what_nobody_needs_is_left_out():
    def function(x):
        spare = jax.lax.while_loop(lambda y: y < 9, lambda y: y * 2, x)
        return [with_derivatives_of(jnp.sin(x), spare)]

    assert names_in(inline_and_fold(jax.make_jaxpr(function)(1.0)).jaxpr) == {"sin"}


def test_what_calls_back_is_left_to_xla():
    """Check that programs that call back to Python are left to XLA.

    A call may stand where it happens only on failure; for all lanes at once it would always happen.
    """

    def function(x):
        return [eqxi.unvmap_any(x > 3) * eqx.error_if(x, x < 0, "negative")]

    with pytest.raises(Unsupported, match="callback"):
        both(function, np.linspace(1, 2, 9))


UNKNOWN = {
    "order": lambda x: jnp.argsort(jnp.stack([x, -x]))[0] * x,
    "gamma": lambda x: jax.scipy.special.gamma(x),
    "running sum": lambda x: jnp.cumsum(x[None])[0],
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_is_not_known_is_said(name):
    """Check the log of operations that machine code cannot do: in a loop or after it; before a loop XLA does them."""

    def doubled(x, more=lambda x: x):
        return jax.lax.while_loop(lambda x: jnp.abs(x) < 50, lambda x: 2 * x + jnp.abs(more(x)), x + 1)

    x = np.linspace(1, 2, 9)
    for function in (lambda x: UNKNOWN[name](doubled(x)), lambda x: doubled(x, UNKNOWN[name])):
        with pytest.raises(Unsupported):
            both(lambda x, function=function: [function(x)], x)
    agree(lambda x: [doubled(UNKNOWN[name](3 * x))], x, rtol=1e-14)


def test_programs_have_names_of_their_own():
    """Made of the program alone, so that another process finds it again in the compilation cache."""
    program, other = (jax.make_jaxpr(lambda x, factor=factor: [jnp.exp(x) * factor])(1.0) for factor in (3, 4))

    def name(program, shared, lanes=8):
        return jit.registered(program, [shared], kernels.emit, lanes, 3)

    assert name(program, False) == name(program, False)
    assert len({name(program, False), name(program, True), name(other, False), name(program, False, lanes=2)}) == 4


class Damper(eqx.Module):
    """The model of docs/how_to/own_physics.md."""

    size: jax.Array

    def __call__(self, opening, velocity, block):
        return self.size * velocity


def damped(a, u):
    model = rk.models.Equation(
        restoring=lambda opening, block: jnp.sin(block.alpha - opening),
        arm=lambda opening, block: jnp.cos(block.alpha - opening),
        dissipation=Damper(0.2),
    )
    return rk.outcome(rk.Block(a, 2.0), rk.SinePulse(u, 0.6), model).margin


def by_diffrax(a, u, motion=rk.SinePulse(1.0, 1.0), model=rk.Housner(), **settings):
    return rk.outcome(rk.Block(a, 2.0, 0.9), u * motion, model, engine=rk.Diffrax(**settings))


def rolled(a, u):
    """A block whose edge radii are given at more angles than registers hold."""
    angles = jnp.linspace(0.0, 0.5, 10)
    edges = rk.blocks.Edge(0.3 * jnp.cos(angles), angles), rk.blocks.Edge(0.1 + 0.2 * angles[:7], angles[:7])
    block = rk.blocks.AsymmetricBlock(a, 1.2 * a, 2.0)
    return rk.outcome(block, rk.SinePulse(u, 0.6), rk.models.Rolling(*edges), engine=rk.Diffrax(rtol=1e-4)).margin


SHORT_SERIES = {"engine": rk.Series(order=4)}  # of the same operations, and compiled in half the time
SHORT = rk.Record(rk.example_record().samples[500:2500], 0.005)
STRONGEST = rk.Record(rk.example_record().samples[320:620], 0.005)
SCENES = {
    "value": lambda a, u: rk.outcome(rk.Block(a, 2.0), rk.SinePulse(u, 1.0)).margin,
    "derivatives": jax.grad(lambda a, u: rk.outcome(rk.Block(a, 2.0), rk.SinePulse(u, 1.0)).margin, (0, 1)),
    "a scaled record": lambda a, u: rk.outcome(rk.Block(a, 2.0), u * rk.example_record()).margin,
    "its derivatives": jax.grad(
        lambda a, u: rk.outcome(rk.Block(a, 2.0), u * rk.example_record(), **SHORT_SERIES).margin, (0, 1)
    ),
    "two records": lambda a, u: (
        rk.outcome(
            rk.Block(a, 2.0), u * STRONGEST + STRONGEST.shifted(0.3), rk.Linear(), engine=rk.Series(order=6)
        ).margin
    ),
    "vertical records": lambda a, u: rk.outcome(rk.Block(a, 2.0), (u * SHORT).with_vertical(0.3 * SHORT)).margin,
    "two sides, exponential, vertical": lambda a, u: (
        rk.outcome(
            rk.blocks.AsymmetricBlock(a, 1.3 * a, 2.0),
            rk.ExponentialPulse(u, 1.0, u).with_vertical(rk.SinePulse(0.1 * u, 0.3)),
            **SHORT_SERIES,
        ).margin
    ),
    "spring": lambda a, u: (
        rk.outcome(rk.Block(a, 2.0), rk.SinePulse(u, 1.0), rk.Spring("SM1", "linear"), **SHORT_SERIES).margin
    ),
    "a plastic spring": lambda a, u: (
        rk.outcome(rk.Block(a, 2.0), rk.SinePulse(u, 1.0), rk.Spring("SM3", "plastic"), **SHORT_SERIES).margin
    ),
    "rolling on edges of two sides": rolled,
    "an equation with a damper": damped,
    "its derivatives by diffrax": jax.grad(damped, (0, 1)),
    "another solver of diffrax": lambda a, u: by_diffrax(a, u, solver=diffrax.Dopri8()).margin,
    "diffrax under a record": lambda a, u: by_diffrax(a, u, SHORT).margin,
}


BESIDE = {"parameter", "constant", "get-tuple-element", "bitcast", "copy", "tuple", "custom-call"}


@pytest.mark.parametrize("size, most", [(8, 18), (65, 18), (None, 32)], ids=["few", "many", "a history"])
def test_xla_compiles_little_beside_machine_code(size, most):
    """Check that XLA compiles little beside machine code: nearly every operation left to it is a program of its own.

    Without machine code for shared values, 28 and 30 operations are left for scenes that share a block. Without it for
    the beginning and end of a history, 38 are left.
    """
    shaken = jax.vmap(lambda alpha, a: rk.outcome(rk.Block(alpha, 2.0), rk.SinePulse(a, 0.6)), (None, 0))
    if size is None:
        shaken = lambda alpha, a: rk.simulate(rk.Block(alpha, 2.0), rk.SinePulse(a, 0.6)).trajectory
    text = jax.jit(shaken).lower(0.2, 0.5 if size is None else np.linspace(0.1, 1.0, size)).compile().as_text()
    operations = re.findall(r"^  (?:ROOT )?%\S+ = .*? ([a-z-]+)\(", text[text.index("ENTRY") :], re.M)
    assert 0 < sum(each not in BESIDE for each in operations) <= most


# Components of the others.
FALL_BACK_SLOWLY = (
    *("a scaled record", "vertical records"),
    *("its derivatives by diffrax", "another solver of diffrax", "diffrax under a record"),
)


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow if x in FALL_BACK_SLOWLY else ()) for x in SCENES]
)
def test_scenes_do_not_fall_back(name, caplog):
    """A program that XLA has to take over is right, but many times as slow, and nothing tells."""
    with caplog.at_level(logging.DEBUG, "jaxrock"):
        jax.jit(jax.vmap(SCENES[name])).lower(jnp.full(333, 0.2), jnp.full(333, 0.5))
    assert "left to XLA" not in caplog.text


@pytest.mark.parametrize(
    "name, count",
    [("derivatives", 40), ("spring", 40), *(pytest.param(x, 100, marks=pytest.mark.slow) for x in SCENES)],
)
def test_at_any_effort(name, count, monkeypatch):
    """Check that LLVM's low effort, as in tests, gives the bits of its high effort."""
    a, u = np.random.default_rng(5).uniform([[0.1], [0.2]], [[0.3], [2.0]], (2, count))
    found = []
    for effort in (0, 3):
        with_effort(effort, monkeypatch)
        found.append(jax.device_get(jax.jit(jax.vmap(lambda a, u: SCENES[name](a, u)))(a, u)))
    for quickly, carefully in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_array_equal(quickly, carefully)
        assert np.isfinite(quickly).mean() > 0.3


def all_of_it(_, u):
    """Return a complete outcome; its error estimates have the most digits that may differ."""
    return rk.outcome(rk.Block(0.2, 2.0), rk.SinePulse(u, 0.8))


# With edges that are lists, XLA computes the first stages and rounds them in its own way.
ONE_ANSWER = [x for x in SCENES if x not in ("derivatives", "rolling on edges of two sides")]


@pytest.mark.parametrize(
    "name", ["all of it", "derivatives", *(pytest.param(x, marks=pytest.mark.slow) for x in ONE_ANSWER)]
)
def test_a_scene_has_one_answer(name, monkeypatch):
    """Alone, within `jit`, among few others that share a number with it or do not, and among many that are taken a few
    at a time: the same to the bit, with LLVM's efforts as users have them."""
    with_effort(3, monkeypatch)
    monkeypatch.setitem(jit.EFFORT, "in a moment", 0)
    scene, u = SCENES.get(name, all_of_it), np.concatenate([np.linspace(0.2, 0.3, 40), np.linspace(0.3, 0.9, 10)])
    found = [[scene(0.2, x) for x in u], [jax.jit(scene)(0.2, x) for x in u]]
    found = [jax.tree.map(lambda *each: np.stack(each), *each) for each in found]
    found.append(jax.vmap(scene, (None, 0))(0.2, u))
    found.append(jax.vmap(scene)(np.full(50, 0.2), u))
    found.append(jax.lax.map(lambda x: scene(0.2, x), np.tile(u, 2), batch_size=50))
    for alone, *others in zip(*map(jax.tree.leaves, found), strict=True):
        for each in others:
            np.testing.assert_array_equal(each[:50], alone)


def with_effort(effort: int, monkeypatch):
    """Compile machine code anew, with so much of it."""
    for kind in jit.EFFORT:
        monkeypatch.setitem(jit.EFFORT, kind, effort)
    for each in list(lane_functions._alike.values()):
        each.compiled.clear()


def test_closed_forms_at_any_effort(monkeypatch):
    """Check closed forms at both efforts: of one number, as users have them, and of many."""
    durations, shapes, found = np.linspace(0.5, 3.0, 9), np.linspace(-0.5, 0.9, 9), []
    for effort in (0, 3):
        with_effort(effort, monkeypatch)
        one, many = (
            jax.jit(how(jax.value_and_grad(single_lobe.safety_wall, (0, 1)))) for how in (lambda f: f, jax.vmap)
        )
        found.append(jax.device_get([*(one(*each) for each in zip(durations, shapes)), many(durations, shapes)]))
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_diffrax_in_lanes():
    """As alone, to the bit, and as the series."""
    a, u = np.linspace(0.1, 0.3, 40), np.linspace(1.3, 0.2, 40)
    linear = functools.partial(by_diffrax, model=rk.Linear())
    found = jax.tree.map(np.asarray, jax.vmap(linear)(a, u))
    for i in (0, 17, 39):
        alone = linear(a[i], u[i])
        jax.tree.map(lambda one, many, i=i: np.testing.assert_array_equal(one, many[i]), alone, found)

    def by_series(a, u):
        return rk.outcome(rk.Block(a, 2.0, 0.9), rk.SinePulse(u, 1.0), rk.Linear(), **SHORT_SERIES)

    exact = jax.tree.map(np.asarray, jax.vmap(by_series)(a, u))
    np.testing.assert_array_equal(found.overturned, exact.overturned)
    np.testing.assert_array_equal(found.impact_count, exact.impact_count)
    np.testing.assert_allclose(found.max_rotation, exact.max_rotation, rtol=1e-6)
    assert 5 < found.overturned.sum() < 35
    assert found.impact_count.max() > 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["an equation with a damper", "its derivatives by diffrax"])
def test_diffrax_as_xla_has_it(name, monkeypatch):
    a, u = jnp.linspace(0.1, 0.3, 20), jnp.linspace(1.3, 0.2, 20)
    found = jax.vmap(SCENES[name])(a, u)
    jax.clear_caches()
    monkeypatch.setattr(lane_programs, "native", None)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(jax.vmap(SCENES[name])(a, u)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7)


@pytest.mark.parametrize(
    "name",
    [
        "two records",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("vertical records", "two sides, exponential, vertical")),
    ],
)
def test_what_a_loop_does_not_change_comes_before_it(name, monkeypatch, caplog):
    """Check that loop invariants are computed first: the knots of two motions are sorted once.

    Blocks give the results of a run entirely by XLA.
    """
    given = np.full(20, 0.2), np.linspace(0.8, 2.0, 20)

    def lowered():
        return jax.jit(lambda a, u: jax.vmap(SCENES[name])(a, u)).lower(*given)

    own = lowered()
    monkeypatch.setattr(lane_programs, "native", None)
    with caplog.at_level(logging.DEBUG, "jaxrock"):
        by_xla = lowered()
    assert "is left to XLA: there is no llvmlite" in caplog.text
    ours = re.compile(r"custom_call @jaxrock_[0-9a-f]{20}\b")
    assert ours.search(own.as_text()) and not ours.search(by_xla.as_text())
    np.testing.assert_allclose(own.compile()(*given), by_xla.compile()(*given), rtol=1e-9)


def test_a_place_of_a_lanes_own_list_in_a_refilled_loop():
    def function(leaves):
        numbers, turns = leaves
        more = lambda c: (c[0] + 1, c[1] + numbers[3])  # noqa: E731
        return list(jax.lax.while_loop(lambda c: c[0] < turns, more, (jnp.int32(0), jnp.float64(0))))

    numbers, turns = np.random.default_rng(0).random((40, 12)), np.arange(40, dtype=np.int32) % 7
    for refilled in (False, True):
        found = run(function, [numbers, turns], [False, False], refilled)
        np.testing.assert_allclose(found[1], numbers[:, 3] * turns, rtol=1e-14)


def test_arrays_that_are_constants_of_a_refilled_loop():
    table, start = np.array([1.0, 2.0, 3.0]), np.array([0.5, -0.5])

    def function(leaves):
        def turn(carry):
            i, pair = carry
            return i + 1, pair[::-1] + table[1:] * leaves[0]

        return list(jax.lax.while_loop(lambda c: c[0] < leaves[1], turn, (jnp.int32(0), start)))

    x, turns = np.linspace(0, 1, 40), np.arange(40, dtype=np.int32) % 5
    found = run(function, [x, turns], [False, False], True)
    expected = jax.jit(jax.vmap(lambda *leaves: function(leaves)))(x, turns)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-15)


def test_an_interface_that_is_not_known_is_left_to_xla(monkeypatch, caplog):
    monkeypatch.setattr(jit, "is_known", lambda: False)
    twice = lane_function(lambda x: 2 * x, in_lanes=True)
    with caplog.at_level(logging.DEBUG, "jaxrock"):
        np.testing.assert_array_equal(jax.vmap(twice)(jnp.arange(5.0)), 2 * np.arange(5.0))
    assert "left to XLA: XLA's interface of this version" in caplog.text


def test_a_record_of_one_sample_beside_a_longer_one(caplog):
    """More scenes than go one by one: the same as without it, fewer at a time, in machine code. Its only sample is
    passed on by a loop, and made by none."""
    caplog.set_level("DEBUG", "jaxrock")
    record = rk.Record(0.5 * np.sin(0.3 * np.arange(40)), 0.02)

    def margins(motion, scales):
        scene = lambda s: rk.outcome(rk.Block(0.15, 2.5), s * motion, rk.Linear(), **SHORT_SERIES).margin  # noqa: E731
        return np.asarray(jax.vmap(scene)(scales))

    scales = np.linspace(0.7, 1.3, 65)
    found = margins(record + rk.Record([0.1], 0.02), scales)
    for some in (slice(0, 33), slice(32, 65)):
        np.testing.assert_allclose(found[some], margins(record, scales[some]), rtol=1e-9, atol=1e-12)
    assert "left to XLA" not in caplog.text


_I64 = ir.IntType(64)


def in_memory(b, x, **settings):
    """Return the memory location of a value."""
    rooms = b.alloca(x.type, 4)
    place = b.gep(rooms, [_I64(2)], **settings)
    b.store(x, place)
    return place


# Name: instructions of real numbers x and y, whole numbers m and n, flags f and g.
INSTRUCTIONS = {
    "sum": lambda b, x, y, m, n, f, g: b.fadd(x, y, flags=("contract",)),
    "difference": lambda b, x, y, m, n, f, g: b.fsub(x, y),
    "product": lambda b, x, y, m, n, f, g: b.fmul(x, ir.Constant(x.type, 0.5), name="half", flags=("contract",)),
    "quotient": lambda b, x, y, m, n, f, g: b.fdiv(x, y),
    "negative": lambda b, x, y, m, n, f, g: b.fneg(x),
    "bits": lambda b, x, y, m, n, f, g: b.xor(b.or_(m, n), b.and_(m, n)),
    "not": lambda b, x, y, m, n, f, g: b.not_(f),
    "choice": lambda b, x, y, m, n, f, g: b.select(f, x, y),
    "whole choice": lambda b, x, y, m, n, f, g: b.select(g, m, n),
    "less": lambda b, x, y, m, n, f, g: b.fcmp_ordered("<", x, y),
    "other": lambda b, x, y, m, n, f, g: b.fcmp_unordered("!=", x, y),
    "no number": lambda b, x, y, m, n, f, g: b.fcmp_unordered("uno", x, x),
    "known": lambda b, x, y, m, n, f, g: b.fcmp_ordered("ord", x, y, flags=("nnan",)),
    "whole sum": lambda b, x, y, m, n, f, g: b.add(m, n, flags=("nsw",)),
    "whole difference": lambda b, x, y, m, n, f, g: b.sub(m, n),
    "whole product": lambda b, x, y, m, n, f, g: b.mul(m, ir.Constant(m.type, 3 if m.type == _I64 else [3] * 8)),
    "whole less": lambda b, x, y, m, n, f, g: b.icmp_signed("<", b.neg(m), n),
    "as if above 0": lambda b, x, y, m, n, f, g: b.icmp_unsigned(">=", m, n),
    "same": lambda b, x, y, m, n, f, g: b.and_(b.icmp_signed("==", m, n), b.icmp_unsigned("!=", f, g)),
    "beside llvmlite's": lambda b, x, y, m, n, f, g: b.add(b.shl(b.xor(m, n), m), b.ashr(b.or_(m, n), n)),
    "in memory": lambda b, x, y, m, n, f, g: b.load(in_memory(b, x), align=1),
    "in a structure": lambda b, x, y, m, n, f, g: b.load(in_memory(b, x, inbounds=True)),
}


def written_by(builder, write, lanes):
    """A function with one instruction, or a few, as LLVM prints it."""

    def of(kind):
        return kind if lanes is None else ir.VectorType(kind, lanes)

    kinds = [of(kind) for kind in (ir.DoubleType(), ir.IntType(64), ir.IntType(1)) for _ in range(2)]
    function = ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), kinds), "f")
    b = builder(function.append_basic_block())
    result = write(b, *function.args)
    room = b.alloca(result.type)
    with b.goto_block(b.block):  # there is no end yet: behind it
        b.store(result, room)
    b.ret_void()
    with b.goto_block(function.blocks[0]):  # before the end
        b.store(write(b, *function.args), room)
    return re.sub(r"%[^ ,)]+", "%", str(binding.parse_assembly(str(function.module))))


@pytest.mark.parametrize("lanes", [None, 8])
@pytest.mark.parametrize("write", INSTRUCTIONS.values(), ids=INSTRUCTIONS)
def test_instructions_are_those_of_llvmlite(write, lanes):
    assert written_by(Builder, write, lanes) == written_by(ir.IRBuilder, write, lanes)


def test_lanes_are_those_of_llvmlite():
    def exchanged(b, x, y, m, n, f, g):
        return b.insert_element(x, b.extract_element(y, ir.IntType(32)(1)), ir.IntType(32)(2))

    assert written_by(Builder, exchanged, 8) == written_by(ir.IRBuilder, exchanged, 8)
    with pytest.raises(ValueError, match="must be of its type, but is of i64"):
        written_by(Builder, lambda b, x, y, m, n, f, g: b.insert_element(x, _I64(1), _I64(0)), 8)
    with pytest.raises(KeyError):
        written_by(Builder, lambda b, x, y, m, n, f, g: b.icmp_signed("ord", m, n), 8)


@pytest.mark.parametrize("name", ["fmul", "mul", "select", "fcmp_ordered", "icmp_signed"])
def test_operands_are_of_one_type(name):
    """As llvmlite, and not only when LLVM reads it: that would leave the program to XLA."""
    kinds = [ir.IntType(1), ir.DoubleType(), ir.FloatType()]
    function = ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), kinds), "f")
    flag, x, y = function.args
    more = {"fmul": (), "mul": (), "select": (flag,)}.get(name, ("<",))
    with pytest.raises(ValueError, match="must be of one type, but are"):
        getattr(Builder(function.append_basic_block()), name)(*more, x, y)
