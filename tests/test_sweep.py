"""Sweeps: every point in its place, whatever the shape of the grid, the size of a block and the number of devices."""

import concurrent.futures
import itertools
import math
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.compiler import lane_function
from jaxrock.compiler.jaxpr.traced_function import TracedFunction
from jaxrock.compiler.primitive import lanes
from jaxrock.sweeps.plan import Plan, layout
from jaxrock.sweeps.runner import Runner
from jaxrock.sweeps.sweep import surface

COMPILED = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, duration, **_: COMPILED.append(event) if event.endswith("backend_compile_duration") else None
)


def test_whole_numbers_that_single_precision_lacks_are_refused():
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"`n` must be whole numbers .*int32.*3000000000"):
        rk.sweep(lambda n: n, n=np.array([3_000_000_000, 5]), progress=False)


def simple(alpha, p):
    """Return results of every type, which NumPy computes to the last bit."""
    return {"sum": alpha + 16 * p, "above": alpha > p, "count": jnp.int32(8 * p), "pair": jnp.stack([alpha, p])}


def lists(*sizes):
    return {name: np.arange(1.0, n + 1) / 8 for name, n in zip(("alpha", "p"), sizes)}


def expected(alpha, p):
    return {
        "sum": alpha + 16 * p,
        "above": alpha > p,
        "count": (8 * p).astype(np.int32),
        "pair": np.stack([alpha, p], -1),
    }


# One point a block takes long for many points, and is the same.
SIZES = [(1, 1), (3, 70), (70, 3), (1, 400), (40, 40)]
BLOCKS = [None, 1, 7, 64, 1000]


@pytest.mark.parametrize("sizes, block", [each for each in itertools.product(SIZES, BLOCKS) if each != ((40, 40), 1)])
def test_every_point_is_in_its_place(sizes, block):
    axes = lists(*sizes)
    grid = rk.sweep(simple, block=block, **axes)
    wanted = expected(*np.meshgrid(*axes.values(), indexing="ij"))
    assert grid.shape == sizes and grid.resumed == 0
    for name, values in wanted.items():
        assert grid.values[name].dtype == values.dtype
        np.testing.assert_array_equal(grid.values[name], values)


@pytest.mark.parametrize("size, block", [(1, None), (200, None), (200, 70)])
def test_axes_side_by_side(size, block):
    axes = lists(size, size)
    grid = rk.sweep(simple, outer=False, block=block, **axes)
    assert grid.shape == (size,)
    for name, values in expected(*axes.values()).items():
        np.testing.assert_array_equal(grid.values[name], values)


def test_axes_keep_their_type_and_one_number_is_a_result():
    grid = rk.sweep(lambda k: jnp.arange(5)[k] ** 2, k=[3, 1, 4])
    np.testing.assert_array_equal(grid.values, [9, 1, 16])
    assert repr(grid) == "Grid(outer, k: 3; value)"


def test_sweep_is_made_of_outcomes():
    record = rk.Record(0.3 * np.sin(np.linspace(0, 6, 40)), 0.05)

    def scene(alpha, p):
        return rk.outcome(rk.Block(alpha, p), record, rk.Linear(), engine=rk.Series(order=6))

    grid = rk.sweep(scene, alpha=[0.1, 0.2], p=np.linspace(1, 9, 40))
    single = jax.jit(jax.vmap(lambda p: scene(0.2, p)))(grid.axes["p"])
    assert isinstance(grid.values, rk.responses.Outcome) and np.all(grid.values.status == rk.Status.successful)
    assert 0 < np.sum(grid.values.overturned) < grid.values.overturned.size
    np.testing.assert_array_equal(grid.values.impact_count[1], single.impact_count)
    np.testing.assert_allclose(grid.values.max_rotation[1], single.max_rotation, rtol=1e-11)


def test_a_sweep_is_compiled_once():
    """All its blocks, the last ones too; and it is not compiled again where only constants differ."""

    def run(constant, sign=1, size=100):
        held = jnp.full(3, constant)
        return rk.sweep(lambda alpha, p: jnp.sum(held * alpha) + sign * p, block=300, **lists(size, 7)).values

    def compilations(*arguments):
        before = len(COMPILED)
        run(*arguments)
        return len(COMPILED) - before

    for size in (100, 40):  # what JAX itself compiles for each length of an axis is compiled here
        run(0.0, 1, size)
    np.testing.assert_allclose(run(2.0)[3], 3.0 + lists(1, 7)["p"])
    np.testing.assert_allclose(run(4.0)[3], 6.0 + lists(1, 7)["p"])
    assert compilations(5.0) == 0
    assert compilations(1.0, 2, 100) == compilations(1.0, 3, 40) > 0  # three blocks, one block


def test_neighbours_share_a_chunk_and_chunks_are_dealt_in_turn():
    found = surface(lambda x, _: jax.lax.axis_index("devices") + jnp.int32(0 * x), (np.arange(640.0),), (), "", False)
    np.testing.assert_array_equal(found, np.repeat([0, 1] * 5, 64))


@pytest.mark.parametrize("shape", [(10**3, 10**3, 10**3), (10**9,), (7, 13, 10**6), (2**20, 3), (257, 257)])
def test_blocks_are_bounded_and_cover_the_grid(shape):
    plan = Plan.of(tuple(np.broadcast_to(0.0, n) for n in shape), True)
    assert math.prod(plan.block) <= 2**18
    assert plan.sizes.sum() == math.prod(shape)
    assert math.prod(plan.blocks) * math.prod(plan.block) <= 1.25 * math.prod(shape)  # what is padded at most


def test_a_runner_takes_any_number_of_points():
    runner = Runner(lambda x, _: x**2, (np.ones(1),), (), 0)
    for size in (0, 1, 127, 128, 129, 8192, 20000):
        np.testing.assert_array_equal(runner([np.arange(float(size))])[0], np.arange(float(size)) ** 2)


@pytest.mark.parametrize("points, lanes", [(0, 1024), (2048, 1024), (2049, 2048), (10**6, 65536)])
def test_a_gpu_takes_all_lanes_at_once(monkeypatch, points, lanes):
    shape = layout(points, 2, "gpu")
    assert shape == (2, lanes)
    monkeypatch.setattr("jaxrock.sweeps.runner.layout", lambda *_: shape)
    x = np.arange(float(points))
    np.testing.assert_array_equal(Runner(lambda x, _: x**2, (x,), (), points)([x])[0], x**2)


@pytest.mark.parametrize("points", [1, 64, 65, 100, 128, 129, 5000, 10**6])
def test_whether_scenes_are_few_is_not_told_by_their_devices(points):
    """Check that few scenes skip the fast pass, which changes last digits, independently of the number of devices."""
    few = {layout(points, devices, "cpu")[1] <= lanes._FEW for devices in (1, 2, 3, 8, 64, 500)}
    assert few == {points <= lanes._FEW}


def test_batches_are_of_few_sizes():
    """Each is compiled: few, that are called few times, and are never filled up beyond the next power of two."""
    sizes = {points: layout(points, 1, "cpu")[1] for points in (*range(1, 3000), *range(3000, 2**14, 97), 10**6)}
    assert len(set(sizes.values())) == 4
    for points, size in sizes.items():
        calls = -(-points // size)
        assert calls <= 8 or size == max(sizes.values())
        assert calls * size <= max(2 ** (points - 1).bit_length(), 128) or points > 2**14


def test_what_fills_a_batch_up_is_one_of_its_points():
    """Check that padding of a batch repeats one of its points: any other point might take for ever."""
    runner, seen = Runner(lambda x, _: x, (np.ones(1),), (), 0), []
    call = runner._call
    runner._call = lambda parts, *rest: seen.append(parts[0]) or call(parts, *rest)
    runner([np.arange(5.0, 105.0)])
    assert seen[0].size > 100 and np.isin(seen[0], np.arange(5.0, 105.0)).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({}, "needs at least one axis"),
        ({"alpha": 0.1}, "`alpha` must be a list of at least one number, but has shape"),
        ({"alpha": []}, "`alpha` must be a list of at least one number"),
        ({"alpha": [[0.1, 0.2], [0.3]]}, r"`alpha` must be a list of numbers, but is \[\[0.1, 0.2\], \[0.3\]\]"),
        ({"alpha": [[0.1]]}, "`alpha` must be a list"),
        ({"alpha": ["a"]}, "`alpha` must be a list .* type <U1"),
        ({"alpha": [0.1], "p": [1.0, 2.0], "outer": False}, "one length, but alpha has 1, p has 2"),
        ({"alpha": [0.1], "p": [1.0], "block": 0}, "`block` must be a whole number, at least 1, but is 0"),
        ({"alpha": [0.1], "p": [1.0], "load": False}, "`load` must be True"),
        ({"sum": [0.1]}, "other names than the axes"),
    ],
)
def test_bad_axes_raise(arguments, message):
    function = (lambda **x: {"sum": x["sum"]}) if "sum" in arguments else simple
    with pytest.raises(ValueError, match=message):
        rk.sweep(function, **arguments)


def test_an_axis_may_have_the_name_of_what_is_given_by_place():
    grid = rk.sweep(lambda function: 2 * function, function=[1.0, 2.0], progress=False)
    np.testing.assert_array_equal(grid.values, [2.0, 4.0])


def test_values_out_of_range_raise():
    with pytest.raises(
        ValueError, match=r"^Argument `restitution` must be in \[0, 1\], but is not at the point \(1.3\).$"
    ):
        rk.sweep(lambda e: rk.Block(0.1, 1.0, e).restitution, e=[0.5, 1.3])


def test_values_out_of_range_within_a_surface_raise():
    with pytest.raises(
        ValueError, match=r"^Argument `restitution` must be in \[0, 1\], but is not at the point \(1.3\).$"
    ):
        surface(lambda e, _: rk.Block(0.1, 1.0, e).restitution, (np.array([0.5, 1.3]),), (), "", False)


def test_checks_do_not_keep_a_program_from_the_cache():
    """JAX keeps no compiled program on disk that may call back to Python, which is how checks raise."""
    traced = TracedFunction.of(lambda e: rk.Block(0.1, 1.0, e).restitution, jax.ShapeDtypeStruct((), np.dtype(float)))
    assert "Argument `restitution` must be in [0, 1]" in traced.program.messages
    assert "callback" not in str(jax.make_jaxpr(traced.program)(0.5, ()))


def test_progress(capsys):
    rk.sweep(simple, **lists(3, 4), progress=True)
    told = capsys.readouterr().err
    assert "12/12" in told and " 0it" not in told
    rk.sweep(simple, **lists(3, 4))
    assert capsys.readouterr().err == ""


def test_a_finished_store_shows_no_bar(capsys, tmp_path):
    pytest.importorskip("zarr")
    for said in ("12/12", "12 of 12 points come from"):
        rk.sweep(simple, **lists(3, 4), progress=True, store=tmp_path / "store")
        told = capsys.readouterr().err
        assert said in told and " 0it" not in told


POINT = jax.ShapeDtypeStruct((), np.dtype(float))


def test_programs_are_told_apart():
    """Constants are arguments, but part of the fingerprint; arrays within a program are part of it."""
    one, two = jnp.arange(3.0), jnp.arange(3.0) + 1

    def traced(function):
        found = TracedFunction.of(function, POINT)
        return found.program, found.fingerprint

    same = traced(lambda x: x * one), traced(lambda x: x * two)
    assert same[0][0] == same[1][0] and hash(same[0][0]) == hash(same[1][0])
    assert same[0][1] != same[1][1] == traced(lambda x: x * two)[1]
    assert same[0][0] != traced(lambda x: x + one)[0]
    assert same[0][0] != traced(lambda x: {"a": x * one})[0]
    inner = [traced(lambda x, c=c: jax.jit(lambda y: y * c)(x)) for c in (one, two)]
    assert inner[0][0] != inner[1][0] and inner[0][1] != inner[1][1]
    close = [traced(lambda x, c=c: x * c) for c in (0.1, np.nextafter(0.1, 1))]
    assert close[0][0] != close[1][0] and close[0][1] != close[1][1]
    called = [
        traced(lambda x, f=f: jax.pure_callback(f, POINT, x, vmap_method="sequential"))
        for f in (lambda x: x, lambda x: -x)
    ]
    assert called[0][0] != called[1][0]
    checks = [traced(lambda x: rk.Block(x, 1.0).restitution) for _ in range(2)]
    assert checks[0][0] == checks[1][0]


class Alike:
    """Functions that print alike."""

    def __init__(self, factor):
        self.factor = factor

    def __call__(self, x):
        return self.factor * x

    def __repr__(self):
        return "alike"


def test_programs_of_scenes_are_told_apart():
    """By what they compute, by arrays in them, and by what they call back to; not by how often they were traced."""

    def traced(function):
        return TracedFunction.of(lambda x: lane_function(function)(x), POINT).program

    def calling(f):
        return traced(lambda x: jax.pure_callback(f, POINT, x, vmap_method="sequential"))

    assert traced(jnp.sin) == traced(jnp.sin) != traced(jnp.cos)
    arrays = [traced(lambda x, c=np.arange(100.0) + c: x * jnp.asarray(c).sum()) for c in (0.0, 1.0, 1.0)]
    assert arrays[0] != arrays[1] == arrays[2]
    one, other = Alike(2.0), Alike(3.0)
    assert calling(one) == calling(one) != calling(other)


def fresh(code, *, seed="0"):
    """Return the output of a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-c", code], env={"PYTHONHASHSEED": seed, "JAX_PLATFORMS": "cpu", "PATH": ""},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


FINGERPRINT = """
import jax, numpy as np, jaxrock as rk
from jaxrock.compiler.jaxpr.traced_function import TracedFunction
record = rk.Record(np.arange(5.0), 0.01)
like = jax.ShapeDtypeStruct((), "float32")
print(TracedFunction.of(lambda p: rk.outcome(rk.Block(0.1, p), record), like).fingerprint)
"""
USE = "import jax; from jaxrock.studies import use_cpu_devices as use; "
PRINTED = {
    USE + "print(use(3), use(3), jax.device_count())": "3 3 3",
    USE + "use(2); jax.devices(); print(use(2))": "2",
    "import os, jaxrock as rk; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
    "print(rk.studies.use_cpu_devices())": "1",
    "import os, jax; from jaxrock.__main__ import main; main(['run', 'missing.AT2']); "
    "print(jax.device_count() == len(os.sched_getaffinity(0)))": "True",
}  # fmt: skip
# JAX starts nothing when it is imported, so every copy of such a process is as a fresh one.
COPIES = """
import os, sys, jax, jaxrock
for code in {codes}:
    sys.stdout.flush()
    copy = os.fork()
    if copy == 0:
        exec(code)
        print(end="\\0", flush=True)
        os._exit(0)
    assert os.waitpid(copy, 0)[1] == 0
"""


@pytest.fixture(scope="module")
def printed():
    """Return the output of each code in a process of its own."""
    codes = [FINGERPRINT, *PRINTED]
    return dict(zip(codes, fresh(COPIES.format(codes=codes)).split("\0")))


def test_fingerprints_are_the_same_in_every_process(printed):
    assert printed[FINGERPRINT].strip() == fresh(FINGERPRINT, seed="1") != ""


@pytest.mark.parametrize("code", PRINTED, ids=[f"code{n}-{text}" for n, text in enumerate(PRINTED.values())])
def test_cpu_devices(printed, code):
    assert printed[code].strip() == PRINTED[code]


def test_cpu_devices_come_too_late():
    assert jax.device_count() == 2
    with pytest.raises(RuntimeError, match="already computes with 2 CPU devices: call `use_cpu_devices` before"):
        rk.studies.use_cpu_devices(3)
    with pytest.raises(ValueError, match="`count` must be a whole number from 1 to 65536, but is 0"):
        rk.studies.use_cpu_devices(0)


def test_sweeps_in_threads_keep_their_checks():
    """Check sweeps in threads: tracing in one thread does not lose another's argument checks."""

    def swept(restitution):
        return rk.sweep(
            lambda restitution, p: rk.Block(0.2, p, restitution).restitution * p,
            restitution=[restitution, 0.5], p=[1.0, 2.0], progress=False,
        )  # fmt: skip

    def tried(number):
        try:
            return np.asarray(swept(0.9 if number % 2 else 1.5).values)
        except ValueError as error:
            return str(error)

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(tried, range(24)))
    for number, answer in enumerate(answers):
        if number % 2:
            np.testing.assert_allclose(answer, np.outer([0.9, 0.5], [1.0, 2.0]))
        else:
            assert "Argument `restitution` must be in [0, 1], but is not at the point (1.5, 1)" in answer


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
@pytest.mark.parametrize(
    "values, shown",
    [
        ([1.0, 1e-50], "1e-50"),
        ([1.0, -1e60], r"-1e\+60"),
        ([1e-40], "1e-40"),  # which processors take as zero
        (np.array([1e39]), r"1e\+39"),
    ],
)
def test_an_axis_beyond_single_precision_is_refused(values, shown):
    with (
        jax.enable_x64(False),
        pytest.raises(ValueError, match=rf"`x` must be numbers of .*float32.* has {shown}: take"),
    ):
        rk.sweep(lambda x: {"y": x}, x=values, progress=False)


@pytest.mark.parametrize(
    "values, message",
    [
        ([2**70], f"must be whole numbers of one type of 64 bits, but has {2**70}"),
        ([2**63 + 1, -1], f"must be whole numbers of one type of 64 bits, but has {2**63 + 1}"),
        (
            [1.0, 1e-320],
            "must be numbers of the precision of the session .*float64.*, but has 1e-320: take another unit.",
        ),
        (np.array(["2020-01-01"], "datetime64[D]"), "must be a list of at least one number, .* type datetime64"),
        (np.array([np.longdouble("1e400")]), "must be (numbers of|a list)"),
    ],
)
def test_an_axis_that_the_session_cannot_hold_is_refused(values, message):
    if np.asarray(values).dtype == np.longdouble and np.finfo(np.longdouble).max == np.finfo(float).max:
        values = np.array([1e-320])  # where long doubles are doubles
    with pytest.raises(ValueError, match=f"`x` {message}"):
        rk.sweep(lambda x: {"y": x}, x=values, progress=False)


def test_zeros_infinities_and_nan_are_kept():
    found = rk.sweep(lambda x: {"y": x}, x=[0.0, -0.0, np.inf, np.nan, 2.3e-308], progress=False)
    np.testing.assert_array_equal(found.values["y"], [0.0, -0.0, np.inf, np.nan, 2.3e-308])


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: rk.Block(0.2, 1e-60), "`p` must be .*, but is 1e-60, which is 0.0 in the precision of the session"),
        (lambda: rk.SinePulse(1e60, 1.0), r"`amplitude` must be .*, but is 1e\+60, which is inf in the precision"),
        (
            lambda: rk.studies.self_similar_spectrum([1.0, 1e-50], [1.0], progress=False),
            "`frequency_ratio` must be .*, but is 1e-50, which is 0.0",
        ),
    ],
)
def test_a_number_is_shown_as_it_was_given(make, message):
    with jax.enable_x64(False), pytest.raises(ValueError, match=message):
        make()
