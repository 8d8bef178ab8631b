"""Programs kept between sessions: found again, refused when damaged, made anew when a dependency changed."""

import gc
import logging
import os
import subprocess
import sys
import threading
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._arguments.annotations import path_of
from jaxrock.command_line.main import main
from jaxrock.compiler.cache import changes, key, store
from jaxrock.compiler.hints import LOW_EFFORT_LIMIT, jit_low_effort, low_effort, low_effort_options
from jaxrock.engines import scene
from jaxrock.sweeps import runner
from jaxrock.sweeps.store import local

NAME, OTHER = "jaxrock_" + 20 * "a", 40 * "b"  # machine code, and a program
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=4)}


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXROCK_CACHE", str(tmp_path / "kept"))
    return store.folder()


def test_the_folder_may_be_that_of_a_user(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("JAXROCK_CACHE", "~/kept")
    assert store.folder().parent == tmp_path / "kept"
    assert path_of("path", "~/record.AT2") == tmp_path / "record.AT2"
    assert local("store", "~/outcomes.zarr") == tmp_path / "outcomes.zarr"


def test_what_is_written_is_read(place):
    assert store.read("machine", NAME) is None
    store.write("machine", NAME, b"content")
    assert store.read("machine", NAME) == b"content"
    assert store.files() == [place / "machine" / NAME]


def test_known_numbers_are_not_compiled(caplog):
    """Arrays of a length that nobody has had: `jnp.asarray` would compile a program for each."""
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        blocks = rk.Block(np.linspace(0.1, 0.3, 37), 2, np.full(37, 0.9, np.float32))
        pulses = rk.SinePulse(np.linspace(0.2, 0.4, 37), np.arange(1, 38))
        assert "Finished XLA" not in caplog.text
        blocks.alpha[::5] + pulses.amplitude[::5]
    assert "Finished XLA" in caplog.text  # of what is computed


@pytest.mark.parametrize("damage", ["a flipped bit", "cut short", "empty", "longer"])
def test_what_is_damaged_is_not_read(place, damage):
    store.write("machine", NAME, b"content" * 100)
    path = place / "machine" / NAME
    content = bytearray(path.read_bytes())
    if damage == "a flipped bit":
        content[200] ^= 1
    path.write_bytes({"cut short": content[:-1], "empty": b"", "longer": content + b"x"}.get(damage, content))
    assert store.read("machine", NAME) is None
    assert not path.exists()  # so that it is made again


def test_the_oldest_goes_first(place):
    names = [f"jaxrock_{i:020}" for i in range(5)]
    for i, name in enumerate(names):
        store.write("machine", name, bytes(1000))
        os.utime(place / "machine" / name, (i, i))
    store.read("machine", names[0])  # used now
    (place / store.OF_JAX).mkdir()
    (place / store.OF_JAX / f"jit_its_own-{64 * '0'}-cache").write_bytes(bytes(5000))
    (place.parent / "of the user").write_bytes(bytes(5000))
    store.prune(3 * 1045)
    kept = [path.name for path in store.files() if path.parent.name == "machine"]
    assert sorted(kept) == [names[0], *names[3:]] and len(store.files()) == 4
    assert (place.parent / "of the user").exists()


def test_nothing_fails_where_nothing_can_be_kept(place):
    place.parent.write_text("a file is in the way")
    store.write("machine", NAME, b"content")
    assert store.read("machine", NAME) is None
    assert float(jax.jit(lambda a: rk.outcome(rk.Block(0.2, 2.0), rk.SinePulse(a, 0.8), **QUICK).margin)(0.3)) > 0


def test_many_write_at_once(place):
    contents = [bytes([i]) * 100_000 for i in range(8)]

    def work(content):
        for _ in range(20):
            store.write("machine", NAME, content)
            assert store.read("machine", NAME) in contents

    threads = [threading.Thread(target=work, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.read("machine", NAME) in contents


def test_facts_of_a_question():
    """Check the facts of a question: equal if only numbers differ, others for another kind, setting, shape or type."""
    block, pulse = rk.Block(0.2, 2.0), rk.SinePulse(0.3, 0.8)
    known = key.key_of((block, pulse, rk.Series()))
    assert known is not None
    assert known == key.key_of((rk.Block(0.3, 1.0), rk.SinePulse(0.1, 2.0), rk.Series()))
    assert known == key.key_of(jax.eval_shape(lambda: (block, pulse, rk.Series())))
    record = rk.example_record()
    others = [
        (rk.Block(0.2, 2.0, rk.restitution.AngularMomentum()), pulse, rk.Series()),
        (block, rk.CosinePulse(0.3, 0.8), rk.Series()),
        (block, pulse, rk.Series(order=12)),
        (block, pulse, rk.Series(tolerance=1e-9)),
        (block, pulse, rk.Diffrax()),
        (block, pulse, rk.Diffrax(rtol=1e-5)),
        (block, record, rk.Series()),
        (block, rk.Record(record.samples[:-1], record.dt), rk.Series()),
        (block, 2.0 * record, rk.Series()),
        (block, rk.Record(np.float32(record.samples), np.float32(0.01)), rk.Series()),
    ]
    told = [key.key_of(each) for each in others]
    assert None not in told and len({known, *told}) == len(others) + 1
    renamed = rk.Record(record.samples, record.dt, name="another")
    assert key.key_of((block, renamed, rk.Series())) == told[6]


def test_what_is_a_users_own_has_no_facts():
    class Mine(rk.SinePulse):
        pass

    equation = rk.models.Equation(lambda x, b: jnp.sin(b.alpha - x), lambda x, b: jnp.cos(b.alpha - x))
    for own in (Mine(0.3, 0.8), equation, lambda x: x, [1.0, object()]):
        assert key.key_of(own) is None


# Of what compiles quickly, in all ways. Who asks little keeps a program of a user's own, too, with checks.
# JAX starts nothing when it is imported, so a copy of a process that has done no more is a session as any other.
_ANSWER = """
import os, pathlib, sys, jax, jax.monitoring
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np, jaxrock as rk
from jaxrock.compiler.primitive.lane_function import LaneFunction
kept = pathlib.Path(os.environ["JAXROCK_CACHE"])
questions, copy = sys.argv[1].split(), os.fork()
questions = questions[copy > 0]
if questions == "few":  # after the other, and after all that was kept is damaged
    assert os.waitpid(copy, 0)[1] == 0
    for path in kept.rglob("*"):
        if path.is_file() and "OF_JAX" not in path.parts:
            content = bytearray(path.read_bytes())
            content[-20] ^= 255
            path.write_bytes(content)
if questions != "all":
    rk.keep_compiled()
traced = []
trace = LaneFunction._trace
LaneFunction._trace = lambda *given: traced.append(1) or trace(*given)
given = dict(model=rk.Linear(), engine=rk.Series(order=4))
def peak(x): return rk.outcome(rk.Block(x[0], 2.0), rk.SinePulse(x[1], 0.8), **given).max_rotation
x = np.array([0.2, 0.3]) * np.linspace(0.98, 1.02, 70)[:, None]
found = [peak(x[0])]
if questions != "one":
    found += [jax.jit(jax.vmap(peak))(x)]
if questions == "all":
    found += [*jax.jit(jax.vmap(jax.grad(peak)))(x).T,
              rk.simulate(rk.Block(0.2, 2.0), rk.SinePulse(0.3, 0.8), **given).rotation,
              rk.overturning_map(x[::9, 1] * 5, [2.0, 3.0], progress=False, **given).margin]
assert "scipy" not in sys.modules  # JAX takes it to get LAPACK ready, which takes longer than an answer
if questions == "all" and copy:
    assert os.waitpid(copy, 0)[1] == 0
print(len(traced), np.concatenate(list(map(np.ravel, found))).tobytes().hex())
if questions != "all":
    events = []
    jax.monitoring.register_event_listener(lambda event, **more: events.append(event))
    function = jax.jit(jax.grad(lambda a: rk.Block(a, 2.0).alpha ** 2))
    print(float(function(0.3)), sum(event.endswith("cache_misses") for event in events), end=" ")
    try:
        print(float(function(-0.3)))
    except Exception as error:
        print(error)
print(end="\\0", flush=True)
""".replace("OF_JAX", store.OF_JAX)


def sessions_of(place, questions):
    """Return the output of two sessions that ask `"all"` questions, a `"few"` (the first of these), or `"one"`."""
    environment, words = os.environ | {"JAXROCK_CACHE": str(place)}, [sys.executable, "-c", _ANSWER, questions]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return map(told, done.stdout.split("\0")[:2])


class Told(NamedTuple):
    """Output of a session: the number of programs traced, and numbers.

    For its own program also a number, how often JAX's cache missed, and a check's message.
    """

    traced: int
    numbers: str
    own: list[str]


def told(said):
    traced, numbers, *own = said.split(maxsplit=4)
    return Told(int(traced), numbers, own)


class Sessions(NamedTuple):
    """Two at once with an empty folder, one after them, and one after all that the first had kept was damaged."""

    first: Told
    beside: Told
    later: Told
    damaged: Told
    kept: set[str]
    seconds: float


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    place = tmp_path_factory.mktemp("sessions")
    start = time.time()
    beside, first = sessions_of(place, "one all")
    seconds = time.time() - start
    kept = {path.parent.name for path in place.rglob("*") if path.is_file() and store.OF_JAX not in path.parts}
    later, damaged = sessions_of(place, "all few")
    return Sessions(first, beside, later, damaged, kept, seconds)


def test_another_session_traces_nothing_and_answers_the_same_bits(sessions):
    numbers = sessions.first.numbers
    assert sessions.first.traced > 0
    assert sessions.later == (0, numbers, [])
    assert sessions.kept == {"lowered", "machine"}
    again, same, _ = sessions.damaged
    assert again > 0 and len(same) == 71 * 16 and numbers.startswith(same)


def test_processes_share_a_folder(sessions):
    """Two at once with an empty one; none waits for another."""
    numbers = sessions.beside.numbers
    assert len(numbers) == 16 and sessions.first.numbers.startswith(numbers)
    assert sessions.seconds < 200


def test_checks_are_kept_with_the_users_own_programs(sessions):
    """By JAX's cache, and they raise when another process finds them there."""
    (number, misses, error), (number_again, misses_again, error_again) = sessions.beside.own, sessions.damaged.own
    assert number == number_again == "0.6"
    assert int(misses) > 0 and int(misses_again) == 0
    assert "Argument `alpha` must be in (0, pi/2)" in error and error == error_again


def test_another_version_of_the_package_asks_anew(place, monkeypatch):
    def ask():
        jax.clear_caches()
        return float(rk.outcome(rk.Block(0.2, 2.0), rk.SinePulse(0.3, 0.8), **QUICK).max_rotation)

    def exports():
        return len(list((place / "lowered").iterdir()))

    first, once = ask(), exports()
    assert ask() == first and exports() == once > 0
    monkeypatch.setattr(key, "versions", lambda: "another")
    assert ask() == first and exports() == 2 * once


def test_settings_are_told_by_their_values():
    """Numbers of NumPy, too: they are no leaves."""
    settings = [np.int64(3), np.int64(4), np.int32(4), 4, np.float32(1e-3), np.float32(1e-9), np.arange(3), np.ones(3)]
    told = {key.key_of((rk.Series(), setting)) for setting in settings}
    assert None not in told and len(told) == len(settings)


def test_code_that_changed_since_it_was_imported_is_not_kept(monkeypatch):
    def asked():
        key._on_disk.cache_clear()
        return key.versions()

    known = asked()
    monkeypatch.setattr(key, "_AT_IMPORT", key._AT_IMPORT[1:])
    assert len({known, asked(), asked()}) == 3
    monkeypatch.undo()
    assert asked() == known


def test_a_package_without_its_text_is_told_by_what_there_is(tmp_path):
    for name, kept in {"text": "base.py", "compiled": "base.pyc", "archive": None}.items():
        root = tmp_path / name
        (root / "package" / "__pycache__").mkdir(parents=True)
        (root / "package" / "__pycache__" / "base.cpython.pyc").touch()
        if kept is None:
            root = root / "whole.zip"
            root.touch()
        else:
            (root / "package" / kept).touch()
        assert [path for path, *_ in key._files(root / "package")] == [root / "package" / kept if kept else root]


def test_a_file_under_the_name_of_another_is_not_read(place):
    for name in (NAME, OTHER):
        store.write("machine", name, name.encode())
    os.replace(place / "machine" / NAME, place / "machine" / OTHER)
    assert store.read("machine", OTHER) is None


@pytest.mark.parametrize("said", ["off", "OFF", " off ", "0", "no", "False"])
def test_nothing_is_kept_where_the_environment_says_so(monkeypatch, said):
    monkeypatch.setenv("JAXROCK_CACHE", said)
    assert store.folder() is None


def test_what_is_imported_meanwhile():
    """Check `changes` while modules are imported by a garbage collection, which may run at any allocation."""
    names = [f"nobody_knows_{number}" for number in range(10_000)]
    left = iter(names)

    def imported(phase, _):
        sys.modules[next(left)] = None

    before = gc.get_threshold()
    gc.callbacks.append(imported)
    try:
        gc.set_threshold(50)
        assert changes.changes() == ""
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(imported)
        for name in names:
            sys.modules.pop(name, None)
    assert next(left) != names[0]


@pytest.mark.parametrize("kind", ["a class", "a module", "code in place"])
def test_what_is_patched_asks_anew_and_is_kept_for_nobody_else(place, monkeypatch, kind):
    """Check that patched code recomputes and is kept for no other session.

    Examples are a test that patches the package, and a notebook that loads an edited module again.
    """

    def ask():
        jax.clear_caches()
        return float(rk.outcome(rk.Block(0.2, 2.0), rk.SinePulse(0.5, 0.61), **QUICK).max_rotation)

    def weaker(self, piece, local, unit, order):
        return [0.5 * x for x in genuine(self, piece, local, unit, order)]

    def patch(monkeypatch):
        if kind == "a class":
            monkeypatch.setattr(rk.SinePulse, "series", weaker)
        elif kind == "a module":
            monkeypatch.setattr(scene, "peak_bound", weaker)
            monkeypatch.setattr(scene, "sum_of_series", weaker)
        else:
            monkeypatch.setattr(
                rk.RickerPulse.series, "__code__", rk.RickerPulse.series.__code__.replace(co_firstlineno=1)
            )

    genuine, known = rk.SinePulse.series, key.versions()
    for first in ("patched", "as it is"):
        monkeypatch.setenv("JAXROCK_CACHE", str(place / first))
        answers = {}
        for now in 2 * (first, *({"patched", "as it is"} - {first})):
            with monkeypatch.context() as patched:
                if now == "patched":
                    patch(patched)
                assert (key.versions() == known) == (now == "as it is")
                found = ask()
                assert answers.setdefault(now, found) == found
        assert (answers["patched"] != answers["as it is"]) == (kind == "a class")


def test_a_folder_that_vanishes(place, monkeypatch):
    def gone(largest):
        raise FileNotFoundError

    monkeypatch.setattr(store, "prune", gone)
    store.write("machine", NAME, b"content")
    assert store.read("machine", NAME) == b"content"


def test_what_cannot_be_deleted_is_said(place, capsys):
    store.write("machine", NAME, b"content")
    assert main(["cache", "--clear"]) == 0 and not store.files()
    assert "1 compiled programs" in capsys.readouterr().out
    store.write("machine", NAME, b"content")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "remove", lambda path: None)  # as in a folder that cannot be written
        assert main(["cache", "--clear"]) == 2
    assert "1 of 1 files" in capsys.readouterr().err and store.files()


def test_programs_of_a_moment():
    """Known numbers have a program of their own, which is compiled quickly; within other programs they are part of
    those, whatever transforms them."""
    traces = []

    @jit_low_effort(static_argnames="power")
    def total(numbers, power):
        traces.append(power)
        return jnp.sum(numbers**power)

    known = jnp.arange(3.0)
    for _ in range(2):
        assert float(total(known, power=2)) == 5.0
    assert traces == [2]
    assert float(jax.jit(lambda x: x * total(known, power=2))(2.0)) == 10.0
    np.testing.assert_array_equal(jax.vmap(lambda x: x * total(known, power=2))(known), 5 * known)
    np.testing.assert_array_equal(jax.grad(lambda x: total(x, power=2))(known), 2 * known)
    np.testing.assert_array_equal(jax.jit(jax.vmap(lambda x: total(x * known, power=2)))(known), 5 * known**2)
    assert float(total(jnp.ones(LOW_EFFORT_LIMIT + 1), power=3)) == LOW_EFFORT_LIMIT + 1
    assert total(jax.device_put(known, jax.devices()[-1]), power=2).devices() == {jax.devices()[-1]}
    with jax.disable_jit():
        assert float(total(known, power=2)) == 5.0


def test_options_of_programs_of_a_moment():
    """Check options of quickly compiled programs: LLVM's effort always, XLA's emitters while a choice exists."""
    assert {"xla_backend_optimization_level": 0} == {
        k: v for k, v in low_effort_options().items() if "emitters" not in k
    }
    assert ("xla_cpu_use_fusion_emitters" in low_effort_options()) or jaxlib.version.__version_info__[:2] > (0, 10)


def test_scenes_that_xla_runs_are_compiled_well(monkeypatch):
    """Check that scenes that XLA runs are compiled thoroughly.

    Code compiled with little effort runs three times as long, which matters only without machine code of the package.
    """
    ways = []

    def jit(function, **settings):
        def compiled(*args):
            ways.append("quickly" if "compiler_options" in settings else "well")
            return function(*args)

        return compiled

    total = jit_low_effort(jit, follows_scenes=True)(jnp.sum)
    for has in (True, False, True):
        monkeypatch.setattr(low_effort, "_has_machine_code", lambda has=has: has)
        assert float(total(jnp.arange(3.0))) == 3.0
    assert ways == ["quickly", "well", "quickly"]


def test_sweeps_are_compiled_as_what_is_in_them_wants(monkeypatch):
    """Check that the content of sweeps chooses their compilation.

    Programs without loops and cheap functions of few points take the least time; all others use XLA's best.
    """
    ways = []
    compiled = jax.stages.Lowered.compile

    def compile_(lowered, options=None):
        ways.append("quickly" if options and "xla_backend_optimization_level" in options else "well")
        return compiled(lowered, options)

    def straight(x):
        return 2 * x

    def halved(x):
        return jax.lax.while_loop(lambda x: x > 1, lambda x: x / 2, x)

    low_effort_options()  # asks this jaxlib once
    monkeypatch.setattr(jax.stages.Lowered, "compile", compile_)
    x = np.arange(5.0)
    with jax.default_device(jax.devices()[-1]):
        for function, expected in ((straight, 2 * x), (halved, [0, 1, 1, 0.75, 1])):
            for _ in range(2):
                np.testing.assert_array_equal(rk.sweep(function, x=x, progress=False).values, expected)
        assert ways == ["quickly", "well"]
        of_one_block = runner.cheap_per_point(lambda x, _: halved(x))
        for scene, points in (((), 5), (np.zeros(500_000), 5), ((), 2**14 + 1)):
            (found,) = runner.Runner(of_one_block, (x,), scene, 5, points)([x])
            np.testing.assert_array_equal(found, [0, 1, 1, 0.75, 1])
        assert ways[2:] == ["quickly", "well", "well"]  # where they are cheap, few, and of a short motion
        monkeypatch.setattr(runner, "LOW_EFFORT_LIMIT", 4)
        for block in (None, 2):  # of few points, of many in all
            np.testing.assert_array_equal(rk.sweep(straight, x=x, block=block, progress=False).values, 2 * x)
    assert len(ways) == 5  # of many points, and on many devices, with the options of `jax.jit`
