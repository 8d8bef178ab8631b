"""Everything that JAX does to functions, done to scenes: results are those of the function itself.

Values by one call for each number; derivatives by differences of these, and of each other.
"""

import copy
import functools
import itertools
import json
import multiprocessing
import pickle
import re
import subprocess
import sys
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jaxrock as rk
from jaxrock.compiler import lane_function
from jaxrock.responses.arguments import _usual, start_of

BLOCK = rk.Block(0.2, 2.0, 0.9)
COLUMN = rk.blocks.FlexibleBlock(0.6, 3.0, 30e9, 2500.0, 0.02)
AT = jnp.linspace(0.28, 0.32, 4)  # the block rocks under all of these
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time


def outcome(amplitude):
    return rk.outcome(BLOCK, rk.SinePulse(amplitude, 0.8), **QUICK).max_rotation


def of_housner(amplitude):
    return rk.outcome(BLOCK, rk.SinePulse(amplitude, 0.8)).max_rotation


def history(amplitude):
    return rk.simulate(BLOCK, rk.SinePulse(amplitude, 0.8), samples=9).rotation[3]


def closed_form(amplitude):
    return rk.closed_form.sine_pulse.first_peak(5 * amplitude, 2.0)


def column(amplitude):
    return rk.outcome(COLUMN, rk.SinePulse(0.95 * amplitude, 0.8)).max_rotation


def by_diffrax(amplitude):
    return rk.outcome(BLOCK, rk.SinePulse(amplitude, 0.8), engine=rk.Diffrax(rtol=1e-9)).max_rotation


SLOW = pytest.mark.slow
FUNCTIONS = [
    outcome, pytest.param(history, marks=SLOW), closed_form, pytest.param(column, marks=SLOW),
    pytest.param(by_diffrax, marks=SLOW),
]  # fmt: skip


@pytest.fixture(params=FUNCTIONS, ids=lambda f: f.__name__, scope="module")
def function(request):
    return request.param


@pytest.fixture(scope="module")
def values(function):
    return np.array([float(function(a)) for a in AT])


@pytest.fixture(scope="module")
def slopes(function):
    return np.array([float(jax.jvp(function, (a,), (1.0,))[1]) for a in AT])


def same(x):
    return x


def mesh():
    return Mesh(np.array(jax.devices()), ("scenes",))


def dealt(function):
    return jax.shard_map(function, mesh=mesh(), in_specs=PartitionSpec("scenes"), out_specs=PartitionSpec("scenes"))


WAYS = {
    "jit": lambda f: jnp.stack([jax.jit(f)(a) for a in AT]),
    "vmap": lambda f: jax.vmap(f)(AT),
    "nested vmap": lambda f: jax.vmap(jax.vmap(f))(AT.reshape(2, 2)).ravel(),
    "vmap of jit": lambda f: jax.vmap(jax.jit(f))(AT),
    "scan": lambda f: jax.lax.scan(lambda carry, a: (carry, f(a)), 0.0, AT)[1],
    "map": lambda f: jax.lax.map(f, AT),
    "while": lambda f: jax.lax.while_loop(
        lambda carry: carry[0] < AT.size, lambda carry: (carry[0] + 1, carry[1].at[carry[0]].set(f(AT[carry[0]]))),
        (0, jnp.zeros_like(AT)),
    )[1],
    "cond": lambda f: jnp.stack([jax.lax.cond(a > 0, f, same, a) for a in AT]),
    "switch, batched": lambda f: jax.vmap(lambda a: jax.lax.cond(a > 0, f, same, a))(AT),
    "shard_map": lambda f: jax.jit(dealt(jax.vmap(f)))(AT),
    "sharded": lambda f: jax.jit(jax.vmap(f))(jax.device_put(AT, NamedSharding(mesh(), PartitionSpec("scenes")))),
    "filter_jit": lambda f: jnp.stack([eqx.filter_jit(f)(a) for a in AT]),
    "filter_vmap": lambda f: eqx.filter_vmap(f)(AT),
    "checkpoint": lambda f: jnp.stack([jax.checkpoint(f)(a) for a in AT]),
}  # fmt: skip

SLOPES = {
    "grad": lambda f: jnp.stack([jax.grad(f)(a) for a in AT]),
    "vmap of grad": lambda f: jax.vmap(jax.grad(f))(AT),
    "grad of vmap": lambda f: jax.grad(lambda x: jax.vmap(f)(x).sum())(AT),
    "jacfwd of vmap": lambda f: np.diagonal(jax.jacfwd(jax.vmap(f))(AT)),
    "jacrev of vmap": lambda f: np.diagonal(jax.jacrev(jax.vmap(f))(AT)),
    "vjp": lambda f: jnp.stack([jax.vjp(f, a)[1](1.0)[0] for a in AT]),
    "linearize": lambda f: jnp.stack([jax.linearize(f, a)[1](1.0) for a in AT]),
    "of a scan": lambda f: jax.grad(lambda x: jax.lax.scan(lambda s, a: (s + f(a), None), 0.0, x)[0])(AT),
    "of a checkpoint": lambda f: jnp.stack([jax.grad(jax.checkpoint(f))(a) for a in AT]),
    "shard_map": lambda f: jax.grad(lambda x: dealt(jax.vmap(f))(x).sum())(AT),
    "filter_grad": lambda f: jnp.stack([eqx.filter_grad(f)(a) for a in AT]),
}


def combinations(ways, few):
    """An outcome in all ways, a closed form in a few: both are recipes."""
    for function, way in itertools.product((outcome, history, closed_form, column, by_diffrax), ways):
        quick = function is outcome or (function is closed_form and way in few)
        yield pytest.param(function, way, id=f"{function.__name__}-{way}", marks=() if quick else SLOW)


@pytest.mark.parametrize("function, way", list(combinations(WAYS, ("vmap", "cond"))), indirect=["function"])
def test_values(way, function, values):
    np.testing.assert_allclose(WAYS[way](function), values, rtol=2e-12)


@pytest.mark.parametrize("function, way", list(combinations(SLOPES, ("vmap of grad",))), indirect=["function"])
def test_slopes(way, function, slopes):
    np.testing.assert_allclose(SLOPES[way](function), slopes, rtol=2e-10)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["jit", "vmap", "shard_map", "map", "cond", "checkpoint"])
def test_histories_of_columns(way):
    """Check histories of columns, which XLA evaluates without machine code."""

    def of(amplitude):
        return rk.simulate(COLUMN, rk.SinePulse(0.95 * amplitude, 0.8), samples=9).rotation[3]

    np.testing.assert_allclose(WAYS[way](of), [float(of(a)) for a in AT], rtol=1e-9)
    if way == "shard_map":
        slopes = [
            jax.jit(lambda x, f=f: jax.jvp(f, (x,), (jnp.ones(4),))[1])(AT) for f in (jax.vmap(of), dealt(jax.vmap(of)))
        ]
        np.testing.assert_allclose(*slopes, rtol=1e-7)


def test_slopes_by_all_samples_within_shard_map():
    """Check slopes of blocks dealt to devices by all samples of one shared record: the sum of their contributions."""
    engine = rk.Series(order=4, tolerance=1e-3)  # few steps, of which both ways tell the same
    samples, alpha = jnp.asarray(0.3 * np.sin(0.3 * np.arange(70))), jnp.linspace(0.2, 0.3, 4)

    def velocities(samples, alpha):
        record = rk.Record(samples, 0.02)
        return jax.vmap(lambda a: rk.outcome(rk.Block(a, 2.0), record, rk.Linear(), engine=engine).max_velocity)(alpha)

    whole, every = PartitionSpec(), PartitionSpec("scenes")
    each = jax.shard_map(velocities, mesh=mesh(), in_specs=(whole, every), out_specs=every)
    there = jax.jit(jax.grad(lambda s: each(s, alpha).sum()))(samples)
    of_one = jax.jit(lambda change: jax.jvp(lambda s: velocities(s, alpha).sum(), (samples,), (change,))[1])
    slopes = [of_one(change) for change in np.eye(70)]  # without a tape
    np.testing.assert_allclose(there, slopes, rtol=1e-12)


def step_of(function):
    """Return the step of differences; values of columns move by 1e-10 where the compiler rounds otherwise."""
    return 1e-4 if function is column else 1e-6


def test_slopes_are_those_of_the_values(function, slopes):
    step = step_of(function)
    differences = [(float(function(a + step)) - float(function(a - step))) / (2 * step) for a in AT]
    np.testing.assert_allclose(slopes, differences, rtol=2e-5)


@pytest.mark.slow
def test_second_derivatives(function):
    bent = jax.vmap(jax.hessian(function))(AT[:2])
    np.testing.assert_allclose(bent, [jax.jacfwd(jax.grad(function))(a) for a in AT[:2]], rtol=1e-8)
    step = step_of(function)
    slope = jax.grad(function)
    differences = [(float(slope(a + step)) - float(slope(a - step))) / (2 * step) for a in AT[:2]]
    np.testing.assert_allclose(bent, differences, rtol=1e-2 if function is column else 2e-5)


def test_eager_jit_and_vmap_to_the_bit():
    one = [rk.outcome(BLOCK, rk.SinePulse(a, 0.8), **QUICK) for a in AT]
    many = jax.vmap(lambda block, pulse: rk.outcome(block, pulse, **QUICK))(
        jax.tree.map(lambda x: jnp.broadcast_to(x, AT.shape), BLOCK), rk.SinePulse(AT, jnp.full(AT.shape, 0.8))
    )
    program = jax.jit(functools.partial(rk.outcome, **QUICK))
    compiled = [program(BLOCK, rk.SinePulse(a, 0.8)) for a in AT]
    for name in ("max_rotation", "max_velocity", "time_of_max", "margin", "clearance", "error", "impact_count"):
        eager = np.array([getattr(each, name) for each in one])
        np.testing.assert_array_equal(eager, getattr(many, name))
        np.testing.assert_array_equal(eager, [getattr(each, name) for each in compiled])


def exported(function, platforms, shape=()):
    return jax.export.export(function, platforms=platforms)(jax.ShapeDtypeStruct(shape, jnp.float64))


def called_in(program):
    """Return the operations that a program calls outside itself."""
    return set(re.findall(r"custom_call @(\w+)", program.mlir_module()))


WITHOUT_THE_PACKAGE = """
import json, sys, jax
jax.config.update("jax_enable_x64", True)
sys.modules["jaxrock"] = None
for line in sys.stdin:
    path, *numbers = json.loads(line)
    program = jax.export.deserialize(bytearray(open(path, "rb").read()))
    print(json.dumps([float(program.call(number)) for number in numbers]), flush=True)
"""


@pytest.fixture(scope="module")
def elsewhere():
    """A process without the package, which runs serialised programs."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", WITHOUT_THE_PACKAGE], **pipes) as process:
        yield process
        process.stdin.close()
        assert process.wait(60) == 0


def test_a_program_for_other_processes(function, values, elsewhere, tmp_path):
    """Serialised, loaded where the package is not, and run."""
    program = exported(jax.jit(function), ["cpu"])
    assert not [call for call in called_in(program) if "jaxrock" in call]
    path = tmp_path / "program"
    path.write_bytes(program.serialize())
    print(json.dumps([str(path), float(AT[1]), np.nan]), file=elsewhere.stdin, flush=True)
    found, of_nonsense = json.loads(elsewhere.stdout.readline())
    assert found == pytest.approx(values[1], rel=1e-11)
    assert np.isnan(of_nonsense)


def under_a_record(alpha):
    return rk.outcome(rk.Block(alpha, 2.0), 2.0 * rk.example_record(), **QUICK).margin


def overturning(intensity):
    return rk.overturning_map(np.linspace(1, 8, 32), intensity, **QUICK).margin


ACCELERATORS = ("cuda", "rocm", "tpu")
# Function, shape, most letters.
LOWERED = {
    "value and gradient": (jax.jit(jax.value_and_grad(of_housner)), (), 1.5e6),
    "outcomes": (jax.jit(jax.vmap(outcome)), (1024,), 2e6),
    "their gradients": (jax.jit(jax.vmap(jax.grad(outcome))), (1024,), 2.5e6),
    "under a record": (jax.jit(jax.vmap(under_a_record)), (1024,), 2e6),
    "a map": (jax.jit(overturning), (32,), 2e6),
    "closed forms": (jax.jit(jax.vmap(closed_form)), (1024,), 2e6),
    "histories": (jax.jit(jax.vmap(history)), (64,), 2e6),
    "by diffrax": (jax.jit(jax.vmap(by_diffrax)), (1024,), 2e6),
}


LOWERED_SLOWLY = "under a record", "a map", "histories", "by diffrax"


@pytest.mark.parametrize("name", [pytest.param(x, marks=SLOW) if x in LOWERED_SLOWLY else x for x in LOWERED])
def test_programs_for_accelerators(name):
    """Check programs for accelerators that are not present: no code of this processor, no call back, bounded size.

    One program is for all kinds of them.
    """
    function, shape, most = LOWERED[name]
    program = exported(function, ACCELERATORS, shape)
    assert program.platforms == ACCELERATORS
    text = program.mlir_module()
    assert not called_in(program) and "callback" not in text
    assert "f64" in text
    assert len(text) < most


def test_nonsense_is_data_in_exported_programs():
    """Check that exported programs return nonsense as data: they cannot raise, so results are NaN with a status."""

    def found(amplitude, alpha):
        result = rk.outcome(rk.Block(alpha, 2.0, 0.9), rk.SinePulse(amplitude, 0.8), **QUICK)
        numbers = [x for x in jax.tree.leaves(result) if jnp.issubdtype(x.dtype, jnp.inexact)]
        return jnp.stack(numbers), result.status == rk.Status.successful, result.status == rk.Status.not_finite

    program = jax.export.export(jax.jit(jax.vmap(found)), platforms=["cpu"])
    rows = np.array([(0.3, 0.2), (np.nan, 0.2), (0.3, -0.2), (0.3, 2.0)])
    numbers, good, none = program(*[jax.ShapeDtypeStruct((4,), jnp.float64)] * 2).call(*rows.T)
    np.testing.assert_array_equal(np.isnan(numbers), [[wrong] * len(numbers[0]) for wrong in (0, 1, 1, 1)])
    np.testing.assert_array_equal(good, [True, False, False, False])
    np.testing.assert_array_equal(none, ~np.asarray(good))
    assert np.isclose(numbers[0], outcome(0.3), rtol=1e-12, atol=0).any()


def test_slopes_of_many_are_those_of_one_and_each_is_computed_once():
    """Check that slopes of many scenes equal those of one, and that each is computed once.

    Within one scene directions are scenes; `grad` may be vmapped later.
    """

    def peak(x):
        return rk.outcome(rk.Block(0.2, x[0], x[1]), rk.SinePulse(x[2], 0.8), **QUICK).max_rotation

    rows = np.linspace([1.5, 0.85, 0.2], [3.0, 0.95, 0.4], 7)
    slopes = jax.vmap(jax.jit(jax.grad(peak)))
    assert set(re.findall(r"size=(\w+)", str(jax.make_jaxpr(slopes)(rows)))) == {"7"}
    np.testing.assert_allclose(slopes(rows), [jax.grad(peak)(row) for row in rows], rtol=1e-10, atol=1e-12)


def test_functions_of_whole_numbers_are_exported():
    """Check export of functions of whole numbers: integers cannot be NaN."""
    program = jax.export.export(jax.jit(lane_function(lambda n: {"twice": 2 * n, "half": n / 2})), platforms=["cpu"])
    made = program(jax.ShapeDtypeStruct((), jnp.int64))
    assert {name: float(x) for name, x in made.call(3).items()} == {"twice": 6, "half": 1.5}


def test_nonsense_raises_at_once_outside_of_jit():
    with pytest.raises(ValueError, match="Argument `alpha` must be in"):
        jax.vmap(lambda alpha: rk.outcome(rk.Block(alpha, 2.0), rk.SinePulse(0.3, 0.8)))(jnp.array([0.2, -0.1]))


def off(function):
    """Return the allowed relative difference between a function alone and within another program.

    It is zero for machine code from beginning to end.
    """
    return 0 if function in (outcome, closed_form) else 1e-9


def test_threads(function):
    """Several threads compile and run at once."""
    found, numbers = {}, np.linspace(0.28, 0.32, 2 if function is column else 8)  # a column compiles for long

    def work(i):
        found[i] = float(jax.jit(lambda a: function(a) * 1.0)(numbers[i]))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(numbers))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_allclose(
        [found[i] for i in range(len(numbers))], [float(function(a)) for a in numbers], rtol=off(function)
    )


@pytest.mark.slow
def test_spawned_processes(monkeypatch):
    """To the bit, with all that comes and goes pickled."""
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(rk.outcome, (BLOCK, PULSE), {"model": rk.Linear()})
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(rk.outcome(BLOCK, PULSE, rk.Linear())), strict=True):
        np.testing.assert_array_equal(one, other)


def test_devices(function):
    with jax.default_device(jax.devices()[1]):
        found = jax.jit(function)(0.3)
    assert found.devices() == {jax.devices()[1]}
    assert float(found) == pytest.approx(float(function(0.3)), rel=off(function), abs=0)
    there = jax.device_put(0.3, jax.devices()[1])
    assert function(there).devices() == {jax.devices()[1]}


def test_debugging(function):
    with jax.debug_nans(True):
        assert float(jax.jit(function)(0.3)) == pytest.approx(float(function(0.3)), rel=off(function), abs=0)
    if function is column:
        return  # thousands of operations, one by one
    with jax.disable_jit():
        assert float(function(0.3)) == pytest.approx(float(function(jnp.asarray(0.3))), rel=1e-9)


def restoring(rotation, block):
    return jnp.sin(block.alpha - rotation)


def arm(rotation, block):
    return jnp.cos(block.alpha - rotation)


PULSE = rk.SinePulse(0.3, 0.8)
RESULTS = {
    "outcome": lambda: rk.outcome(BLOCK, PULSE, **QUICK),
    "history": lambda: rk.simulate(BLOCK, PULSE, samples=9, **QUICK),
    "history by an equation of one's own": lambda: rk.simulate(
        BLOCK, PULSE, rk.models.Equation(restoring, arm), samples=9
    ),
    "histories": lambda: jax.vmap(lambda a: rk.simulate(BLOCK, rk.SinePulse(a, 0.8), samples=9, **QUICK))(AT),
    "history of a column": lambda: rk.simulate(COLUMN, PULSE, samples=9),
    "map": lambda: rk.overturning_map(np.linspace(1, 8, 3), np.linspace(1, 9, 3), **QUICK),
    "sensitivity": lambda: rk.studies.sensitivity(BLOCK, PULSE, **QUICK),
}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=SLOW) if "column" in x or "equation" in x else x for x in RESULTS]
)
def test_results_are_pickled_and_kept(name, tmp_path):
    found = RESULTS[name]()
    eqx.tree_serialise_leaves(tmp_path / "found", found)
    loaded = eqx.tree_deserialise_leaves(tmp_path / "found", found)
    for again in (pickle.loads(pickle.dumps(found)), copy.deepcopy(found), copy.copy(found), loaded):
        assert jax.tree.structure(again) == jax.tree.structure(found)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
            np.testing.assert_array_equal(one, other)
    if name.startswith("history"):
        again = pickle.loads(pickle.dumps(found))
        np.testing.assert_array_equal(again(0.7)[0], found(0.7)[0])


@pytest.mark.slow
def test_a_history_is_pickled_by_the_function_that_it_is_of():
    """Check that a pickled history belongs to its function, even after one of an equal program was asked for."""
    nameless = rk.models.Equation(lambda rotation, block: jnp.sin(block.alpha - rotation), arm)
    for model in (nameless, rk.models.Equation(restoring, arm)):
        found = rk.simulate(BLOCK, PULSE, model, samples=9)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found)).rotation_ratio, found.rotation_ratio)


@pytest.mark.slow
def test_a_history_by_a_function_that_is_not_what_it_was(monkeypatch):
    """Check that a history of a changed function fails to load: it is pickled by its name, as Python does it."""
    found = pickle.dumps(RESULTS["history by an equation of one's own"]())
    code = restoring.__code__
    monkeypatch.setattr(restoring, "__code__", (lambda rotation, block: 2 * jnp.sin(block.alpha - rotation)).__code__)
    assert restoring.__code__ is not code
    with pytest.raises(ValueError, match="computes something else now"):
        pickle.loads(found)


@pytest.mark.slow
def test_a_history_by_a_function_that_holds_arrays_is_not_pickled():
    held = np.array([1.0, 0.5])
    model = rk.models.Equation(lambda rotation, block: held[0] * jnp.sin(block.alpha - rotation), arm)
    found = rk.simulate(BLOCK, PULSE, model, samples=9)
    with pytest.raises((pickle.PicklingError, AttributeError), match="pickle"):
        pickle.dumps(found)


def test_a_search_by_optax_under_vmap():
    """L-BFGS with its line search from several starts at once, as from each alone."""

    def loss(x):
        found = rk.outcome(BLOCK, rk.SinePulse(jnp.exp(x[0]), jnp.exp(x[1])), **QUICK)
        return (found.margin - 0.5) ** 2 + 1e-3 * (x**2).sum()

    def search(x):
        optimiser = optax.lbfgs()
        value_and_slope = optax.value_and_grad_from_state(loss)

        def step(carry, _):
            x, state = carry
            value, slope = value_and_slope(x, state=state)
            change, state = optimiser.update(slope, state, x, value=value, grad=slope, value_fn=loss)
            return (optax.apply_updates(x, change), state), value

        return jax.lax.scan(step, (x, optimiser.init(x)), None, length=12)[1]

    starts = np.log([[0.3, 0.8], [0.4, 0.7], [0.35, 0.9]])
    many = np.asarray(jax.jit(jax.vmap(search))(starts))
    assert (many[:, -1] < 0.1 * many[:, 0]).all()
    np.testing.assert_allclose(many[0], jax.jit(search)(starts[0]), rtol=1e-6)


def margin_by(x):
    """Return the margin of a block by the logarithms of a pulse's amplitude and period."""
    return rk.outcome(BLOCK, rk.SinePulse(jnp.exp(x[0]), jnp.exp(x[1])), **QUICK).margin


def by_adam(x):
    optimiser = optax.adam(0.05)

    def step(carry, _):
        x, state = carry
        change, state = optimiser.update(jax.grad(lambda x: (margin_by(x) - 0.5) ** 2)(x), state, x)
        return (optax.apply_updates(x, change), state), None

    return jax.lax.scan(step, (x, optimiser.init(x)), None, length=200)[0][0]


def root(x):
    """Return a residual of the amplitude alone: as many equations as unknowns."""
    solver = optimistix.Newton(rtol=1e-10, atol=1e-10)
    found = optimistix.root_find(lambda a, _: margin_by(jnp.stack([a, x[1]])) - 0.5, solver, x[0], max_steps=50)
    return jnp.stack([found.value, x[1]])


def least_squares(x):
    solver = optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    return optimistix.least_squares(lambda x, _: margin_by(x) - 0.5, solver, x, max_steps=100).value


def least(x):
    solver = optimistix.BFGS(rtol=1e-8, atol=1e-12)
    return optimistix.minimise(lambda x, _: (margin_by(x) - 0.5) ** 2, solver, x, max_steps=200).value


@pytest.mark.slow
@pytest.mark.parametrize("search", [by_adam, root, least_squares, least], ids=lambda f: f.__name__)
def test_searches_for_a_margin(search):
    """From one start, and from several at once."""
    starts = jnp.log(jnp.array([[0.3, 0.8], [0.33, 0.7], [0.31, 0.85]]))
    many = jax.jit(jax.vmap(search))(starts)
    np.testing.assert_allclose(jax.vmap(margin_by)(many), 0.5, atol=1e-3 if search is by_adam else 1e-6)
    np.testing.assert_allclose(many[0], jax.jit(search)(starts[0]), rtol=1e-6)


def test_settings_are_made_anywhere():
    """Also where JAX traces what is known."""

    def scaled(x):
        return x * rk.Series(tolerance=1e-9).tolerance / rk.Diffrax(rtol=1e-9).rtol

    np.testing.assert_allclose(jax.grad(lambda x: dealt(scaled)(x).sum())(AT), np.ones(4), rtol=1e-15)


def test_what_is_kept_belongs_to_no_trace():
    """Check that cached objects belong to no trace, even if JAX traces the first scene of a session."""
    _usual.clear()
    dealt(jax.vmap(outcome))(AT)
    assert not any(isinstance(x, jax.core.Tracer) for x in start_of((0.0, 0.0)))


def test_steps_before_times_are_found_by_numpy_as_within_jit():
    """To the bit: at steps, between and after them, at an impact, of times of any shape, where steps were too few."""
    for steps, is_whole in ((None, True), (6, False)):
        engine = rk.Series(order=6, max_steps=steps)
        response = rk.simulate(BLOCK, rk.SinePulse(0.3, 0.8), rk.Linear(), engine=engine, samples=5)
        path = response.trajectory
        assert is_whole == (response.status == rk.Status.successful)
        assert path.equally_spaced(5)[-1] == path.duration
        known = np.asarray(path.times)
        known = known[np.isfinite(known) & (known <= path.duration)]
        times = np.concatenate([known, (known[1:] + known[:-1]) / 2, np.linspace(0, path.duration, 9)])
        found = jax.tree.leaves(path.before(times, path.nodes))
        within = jax.tree.leaves(jax.jit(lambda path, t: path.before(t, path.nodes))(path, times))
        assert all(isinstance(x, np.ndarray) for x in found) and np.isnan(found[-1]).any() != is_whole
        for one, other in zip(found, within, strict=True):
            np.testing.assert_array_equal(one, other)
        rows = times[: times.size // 2 * 2].reshape(2, -1)
        for one, other in zip(response(rows), jax.jit(lambda r, t: r(t))(response, rows), strict=True):
            np.testing.assert_array_equal(one, other)


def test_events_are_found_by_numpy_as_within_jit():
    """To the bit: impacts and turning points, of rest too, and where steps were too few."""
    names, by_jit = ("impact_times", "impact_velocities", "peak_times", "peak_rotations"), None
    for amplitude, steps in ((0.3, None), (0.3, 6), (0.1, None)):
        engine = rk.Series(order=6, max_steps=steps)
        response = rk.simulate(BLOCK, rk.SinePulse(amplitude, 0.8), rk.Linear(), engine=engine, samples=5)
        by_jit = by_jit or jax.jit(lambda r: [getattr(r, name) for name in names])
        for name, filled in zip(names, map(np.asarray, by_jit(response)), strict=True):
            found = np.asarray(getattr(response, name))
            np.testing.assert_array_equal(found, filled[: found.size])
            assert (filled[found.size :] == (np.inf if "times" in name else 0)).all()
            assert steps or (found.size > 0) == (amplitude > 0.2)
