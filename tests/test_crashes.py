"""Promises when a run breaks (docs/crashes.md): losses are named, and no wrong result is returned."""

import concurrent.futures
import errno
import gc
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._core.atomic_files import _reach_the_disk
from jaxrock.sweeps import devices, netcdf
from jaxrock.sweeps.store import Store, local, opened
from references import damage, kills, threads

xarray, zarr = pytest.importorskip("xarray"), pytest.importorskip("zarr")
pytest.importorskip("h5netcdf")

AXES = {"alpha": np.linspace(0.1, 0.3, 9), "p": np.linspace(1.0, 3.0, 50)}


def wave(alpha, p):
    return {"sine": jnp.sin(alpha * p), "above": alpha > 0.2, "count": jnp.int32(8 * p), "pair": jnp.stack([alpha, p])}


def run(store=None, **options):
    return rk.sweep(wave, store=store, **{"block": 100, "progress": False} | AXES | options)


@pytest.fixture(scope="module")
def right():
    return damage.bits(run())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A store of five blocks, the last of them smaller."""
    path = tmp_path_factory.mktemp("finished") / "a.zarr"
    run(path, load=False)
    return path


@pytest.fixture
def store(finished, tmp_path):
    """A copy, which may be damaged."""
    return shutil.copytree(finished, tmp_path / "a.zarr")


@pytest.fixture(scope="module")
def grid():
    return rk.studies.Grid({"k": np.arange(3000.0)}, {f"r{n}": np.arange(3000.0) + n for n in range(20)})


# Damaged files.


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def cut(file):
    file.write_bytes(file.read_bytes()[:-3])


def empty(file):
    file.write_bytes(b"")


def vanish(file):
    file.unlink()


def from_elsewhere(file):
    """Good bytes of the first block, or of the second."""
    other = Path(str(file).replace("/c/", "/other/")).parts
    at = other.index("other")
    first = Path(*other[:at], "c", str(int(other[at + 1] == "0")), *other[at + 2 :])
    file.write_bytes(first.read_bytes())


BLOCKS = ["sine/c/1/0", "above/c/2/0", "count/c/0/0", "pair/c/4/0/0"]
RECORDS = ["jaxrock_blocks/c/1/0/0/0"]
DESCRIPTIONS = ["zarr.json", "jaxrock_blocks/store.json", "sine/zarr.json", "p/zarr.json", "jaxrock_blocks/zarr.json"]
MOVED = [file for file in BLOCKS + RECORDS if "count" not in file]  # which is the same in the first two blocks
DAMAGE = [(how, file) for how in (flip, cut, empty, vanish) for file in BLOCKS + RECORDS + DESCRIPTIONS + ["alpha/c/0"]]


@pytest.mark.parametrize("how, file", DAMAGE + [(from_elsewhere, file) for file in MOVED])
def test_what_is_damaged_is_named_and_computed_again(store, right, file, how):
    """Check that damaged files are named and computed again.

    A plain load refuses them. The name is that of the file; of an axis it is that of its folder.
    """
    how(store / file)
    named = str(store / file.removesuffix("/c/0"))
    if how is vanish and file in RECORDS:  # as if it had never been computed
        with pytest.raises(ValueError, match="is not finished: 4 of 5 blocks"):
            rk.studies.Grid.load(store)
        assert run(store).resumed == 350
    else:
        with pytest.raises(ValueError, match=f"is damaged: .*{named}"):
            rk.studies.Grid.load(store)
        with pytest.warns(UserWarning, match=f"is damaged: .*{named}.* is computed again"):
            run(store, load=False)
    assert damage.bits(rk.studies.Grid.load(store)) == right
    assert run(store).resumed == 450


def test_one_warning_names_all_that_is_damaged(store, right):
    for name in ("sine/c/1/0", "pair/c/4/0/0", "p/c/0"):
        flip(store / name)
    with pytest.warns(UserWarning) as said:
        assert damage.bits(run(store)) == right
    (warning,) = said
    assert all(f"{store / name}" in str(warning.message) for name in ("sine/c/1/0", "pair/c/4/0/0", "p"))


def test_without_any_description_a_store_is_refused(store):
    flip(store / "zarr.json")
    flip(store / "jaxrock_blocks" / "store.json")
    for use in (run, rk.studies.Grid.load):
        with pytest.raises(ValueError, match=f"{store} is damaged: nothing can be known of it"):
            use(store)


def test_a_block_of_another_store_is_not_taken(store, tmp_path):
    """Although it is whole, with its record, and at the same place."""
    other = tmp_path / "b.zarr"
    rk.sweep(lambda alpha, p: wave(alpha, 2 * p), store=other, load=False, block=100, progress=False, **AXES)
    for file in ("sine/c/1/0", "above/c/1/0", "count/c/1/0", "pair/c/1/0/0", "jaxrock_blocks/c/1/0/0/0"):
        shutil.copy(other / file, store / file)
    with pytest.raises(ValueError, match="is damaged"):
        rk.studies.Grid.load(store)


def test_what_was_not_computed_is_no_result_to_other_readers_either(store):
    for file in ("sine/c/1/0", "above/c/1/0", "count/c/1/0", "pair/c/1/0/0"):
        (store / file).unlink()
    opened(store).mark("unfinished")
    with xarray.open_dataset(store, engine="zarr", chunks=None) as data:
        for name in ("sine", "above", "count", "pair"):
            missing = np.isnan(data[name])
            assert missing[2:4].all() and not missing[:2].any() and not missing[4:].any()


def test_blocks_without_any_number_are_told_from_none(tmp_path):
    """Check blocks of NaN only, of either sign: NaN is a result like any other."""
    grids = [
        rk.sweep(lambda x: -jnp.nan * x, store=tmp_path / "a.zarr", block=2, progress=False, x=[1.0, 2.0, 3.0])
        for _ in range(2)
    ]
    assert damage.bits(grids[0]) == damage.bits(grids[1]) and grids[1].resumed == 3
    (tmp_path / "a.zarr/value/c/1").unlink()
    with pytest.raises(ValueError, match="value/c/1"):
        rk.studies.Grid.load(tmp_path / "a.zarr")


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_files_that_nobody_saved_are_refused(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    with pytest.raises(FileNotFoundError, match=str(path)):
        rk.studies.Grid.load(path)
    data = xarray.Dataset({"x": ("k", np.arange(3.0))}, {"k": np.arange(3.0)}, {"layout": "outer"})
    if ending == ".nc":
        data.to_netcdf(path, engine="h5netcdf")
    else:
        data.to_zarr(path, consolidated=False)
    with pytest.raises(ValueError, match=f"{path}"):
        rk.studies.Grid.load(path)


@pytest.mark.parametrize("count", [20, pytest.param(120, marks=pytest.mark.slow)])
def test_damaged_at_random(count):
    """By kept seeds: stores and saved grids, of outcomes; the long one has 72 stores, and had 504 by hand."""
    found = damage.attack(count)
    assert sum(often for (*_, what), often in found.items() if what.startswith("loaded")) == count


# A full disk, and a save that is killed.


@pytest.fixture
def small_disk():
    """Files of this process cannot grow beyond some bytes, from when it is called; as on a full disk, writing fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


SAVES = """
import itertools, os, resource, sys
import numpy as np
import jaxrock as rk
grid = rk.studies.Grid({"k": np.arange(12000.0)}, {f"r{n}": np.arange(12000.0) + n for n in range(5)})
for ending in (".zarr", ".nc"):
    folder = os.path.join(sys.argv[1], "of " + ending[1:])
    os.mkdir(folder)
    path = os.path.join(folder, "a" + ending)
    grid.save(path)
    size = sum(os.path.getsize(os.path.join(at, name)) for at, _, names in os.walk(folder) for name in names)
    os.rename(path, path + ".whole")
    for limit in range(0, size if ending == ".nc" else 500, size // 60 if ending == ".nc" else 50):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, -1))
        try:
            grid.save(path)
        except OSError as error:
            assert error.filename == path and "Nothing was saved" in str(error), error
        else:
            raise AssertionError("saved on a full disk")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))
        assert os.listdir(folder) == ["a" + ending + ".whole"], os.listdir(folder)
    grid.save(path)
    again = rk.studies.Grid.load(path)
    assert all((again.values[name] == grid.values[name]).all() for name in grid.values)
    print("alive after", ending, flush=True)

print("waits", flush=True)
place = sys.stdin.readline().strip()
grid = rk.studies.Grid({"k": np.arange(3000.0)}, {f"r{n}": np.arange(3000.0) + n for n in range(20)})
for number in itertools.count():  # until it is killed
    for ending in (".nc", ".zarr"):
        grid.save(f"{place}/{number}{ending}")
"""


class Saves(NamedTuple):
    """A process that saves grids, what it has said, and where it waits to save more."""

    process: subprocess.Popen
    said: list[str]
    folder: Path


@pytest.fixture(scope="module")
def saves(tmp_path_factory):
    """It saves on disks that are ever less full: HDF5 ended Python when it could not."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | {"JAX_PLATFORMS": "cpu"}
    folder = tmp_path_factory.mktemp("saves")
    with (folder / "errors").open("w") as errors, subprocess.Popen(
        [sys.executable, "-c", SAVES, folder], env=environment, cwd=Path(rk.__file__).parents[1], text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
    ) as process:  # fmt: skip
        patience, said = threading.Timer(300, process.kill), []
        try:
            patience.start()
            for line in process.stdout:
                said.append(line.strip())
                if line == "waits\n":
                    break
            patience.cancel()
            yield Saves(process, said, folder)
        finally:
            patience.cancel()
            process.kill()


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_a_grid_is_saved_whole_or_not_at_all(saves, ending):
    errors = (saves.folder / "errors").read_text()
    assert f"alive after {ending}" in saves.said, errors
    assert ending != ".nc" or saves.said[-1] == "waits", errors


def test_a_killed_save_leaves_all_or_nothing(saves, tmp_path, grid):
    process, wait = saves.process, 0.2 * np.random.default_rng(4).random()
    process.stdin.write(f"{tmp_path}\n")
    process.stdin.flush()
    end = time.monotonic() + 100
    while not (tmp_path / "1.zarr").exists() and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(wait)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    there = [path for path in tmp_path.iterdir() if not path.name.endswith(".partial")]
    assert len(there) >= 4 and all(damage.bits(rk.studies.Grid.load(path)) == damage.bits(grid) for path in there)


def test_results_outlive_a_full_disk(tmp_path, small_disk, grid):
    small_disk(10_000)
    with pytest.raises(OSError, match="Nothing was saved"):
        grid.save(tmp_path / "a.nc")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fails_at", [0, 1, 4])
def test_a_full_disk_keeps_what_is_finished(tmp_path, monkeypatch, small_disk, fails_at):
    """Outcomes under a record, which stay in the store."""
    write, path, room = Store.write, tmp_path / "a.zarr", resource.getrlimit(resource.RLIMIT_FSIZE)[1]

    def filling(self, number, leaves):
        if number == fails_at:
            small_disk(20)  # bytes: not even one result
        write(self, number, leaves)

    monkeypatch.setattr(Store, "write", filling)
    with pytest.raises(OSError, match="the same sweep goes on from there") as raised:
        damage.swept(path, load=False)
    assert raised.value.errno == errno.EFBIG and raised.value.filename == str(path)
    monkeypatch.undo()
    small_disk(room)
    grid = damage.swept(path)
    assert grid.resumed == {0: 0, 1: 4, 4: 14}[fails_at]
    assert damage.bits(grid) == damage.bits(damage.swept())


def test_a_store_that_cannot_be_made_leaves_nothing(tmp_path, small_disk):
    small_disk(100)
    with pytest.raises(OSError):
        run(tmp_path / "a.zarr")
    assert not list(tmp_path.iterdir())


# Interrupts and kills.


def interrupted(function, after):
    """Return whether Ctrl-C arrived before the function finished, this many seconds after its start."""

    def strike(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, strike)
    try:
        signal.setitimer(signal.ITIMER_REAL, after)
        function()
        return False
    except KeyboardInterrupt:
        return True
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def often_interrupted(function, takes, wanted, seed):
    """Interrupt a function, which takes so long, at random until Ctrl-C came before its end often enough; yields after
    each attempt. One that was done sooner than that (another process was in the way of the first) takes less."""
    rng, often = np.random.default_rng(seed), 0
    while often < wanted:
        came = interrupted(function, takes * rng.random())
        often, takes = often + came, takes if came else 0.8 * takes
        yield
    gc.collect(1)  # what was left open is found now, where it may be, and not in the midst of another test


def seconds(function):
    start = time.monotonic()
    function()
    return time.monotonic() - start


# Ctrl-C between the opening of a file and the `with` that closes it, in a library or here, leaves it to Python; and
# between a coroutine and who waits for it, in Zarr.
left_open = pytest.mark.filterwarnings(
    "ignore:unclosed file:ResourceWarning", "ignore:coroutine .* was never awaited:RuntimeWarning"
)


@left_open
def test_an_interrupted_sweep_of_outcomes_goes_on(tmp_path):
    """Anywhere: while it is made, read, computed or written."""
    wanted, path = damage.bits(damage.swept()), tmp_path / "a.zarr"
    takes = seconds(lambda: damage.swept(tmp_path / "b.zarr", load=False))
    for number, _ in enumerate(often_interrupted(lambda: damage.swept(path, load=False), takes, wanted=6, seed=1)):
        if number % 4 == 3:
            assert damage.bits(damage.swept(path)) == wanted
            shutil.rmtree(path)


@left_open
@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_an_interrupted_save_leaves_nothing(tmp_path, grid, ending):
    takes, path = seconds(lambda: grid.save(tmp_path / f"whole{ending}")), tmp_path / f"a{ending}"
    for _ in often_interrupted(lambda: grid.save(path), takes, wanted=4, seed=2):
        if path.exists():
            assert damage.bits(rk.studies.Grid.load(path)) == damage.bits(grid)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        assert [other.name for other in tmp_path.iterdir()] == [f"whole{ending}"]


@pytest.mark.slow  # fast: `test_a_killed_job_goes_on`, and a sweep of outcomes that is interrupted, above
@pytest.mark.parametrize("number, count, block", [(2, 2, 400), (8, 4, 100)])
def test_killed_at_random(number, count, block):
    """Processes that share a job, and others that know nothing of each other: every file is as if undisturbed.

    By hand 200 were killed.
    """
    found = kills.attack(number, seed=3, count=count, block=block)
    assert found["kills"] >= number and found["stores compared"] > 0


# Two writers, and threads.


def test_many_make_one_store_together(tmp_path, right):
    path, barrier = tmp_path / "folder" / "a.zarr", threading.Barrier(6)

    def one(_):
        barrier.wait()
        return damage.bits(run(path))

    with concurrent.futures.ThreadPoolExecutor(6) as pool:
        assert list(pool.map(one, range(6))) == [right] * 6
    assert [other.name for other in path.parent.iterdir()] == ["a.zarr"]


def test_somebody_else_saved_meanwhile(tmp_path, monkeypatch, grid):
    """Check that a file that another process saved meanwhile stays."""
    write = netcdf._Patient._write

    def slow(self, at, data):
        (tmp_path / "a.nc").write_text("theirs")
        write(self, at, data)

    monkeypatch.setattr(netcdf._Patient, "_write", slow)
    with pytest.raises(FileExistsError, match="a.nc was made by somebody else meanwhile"):
        grid.save(tmp_path / "a.nc")
    assert (tmp_path / "a.nc").read_text() == "theirs" and len(list(tmp_path.iterdir())) == 1


def test_many_processes_share_one_sweep_at_a_time(monkeypatch):
    """Their order of meetings is all that they agree on; a thread would change it."""
    monkeypatch.setattr(jax, "process_count", lambda: 2)

    def another():
        with devices.shared_out():
            pass

    with devices.shared_out(), devices.shared_out(), concurrent.futures.ThreadPoolExecutor(1) as pool:
        with pytest.raises(RuntimeError, match="shares one sweep at a time"):
            pool.submit(another).result()
    another()


def test_threads_at_once_answer_as_one_alone(tmp_path):
    wanted = {name: threads.answer(question) for name, question in threads.questions(tmp_path, few=True).items()}
    jax.clear_caches()  # they compile at once, too
    found = threads.asked_by_threads(0.5, 8, 0, wanted, tmp_path, few=True)
    assert not found["wrong"] and sum(found["asked"].values()) >= 8


@pytest.mark.slow
def test_processes_and_threads_at_once_answer_as_one_alone():
    found = threads.attack(20.0)
    assert not found["wrong"] and min(found["asked"].values()) > 1 and sum(found["asked"].values()) > 64


# Other versions, other places, names.


@pytest.mark.parametrize(
    "part, change",
    [
        ("version of JAX", {"jax": "jax 99.0"}),
        ("version of JAX", {"jaxlib": "jaxlib 99.0"}),
        ("version of jaxrock", {"jaxrock": "jaxrock 99.0"}),
        ("version of llvmlite", {"llvmlite": "no llvmlite"}),
        ("code of jaxrock", {}),
    ],
)
def test_other_versions_do_not_go_on(store, monkeypatch, part, change):
    """Their last digits might differ. What is finished is read by any version that knows the format."""
    name = "jaxrock.sweeps.description.cache."
    monkeypatch.setattr(name + "version_of", lambda of: change.get(of, f"{of} 1.0"))
    monkeypatch.setattr(name + "code_digest", lambda: "some code")
    shutil.rmtree(store)
    run(store)
    monkeypatch.setattr(name + "version_of", lambda of: f"{of} 1.0")
    if not change:
        monkeypatch.setattr(name + "code_digest", lambda: "other code")
    with pytest.raises(ValueError, match=f"{store} was made by another sweep: other {part}. Take"):
        run(store)
    assert rk.studies.Grid.load(store).shape == (9, 50)


@pytest.mark.parametrize(
    "path",
    ["s3://bucket/a.zarr", "memory://a.zarr", "gs://a.nc", "simplecache::s3://a.zarr", Path("s3://bucket/a.zarr")],
)
def test_object_stores_are_refused_by_name(path, grid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for argument, use in (("store", run), ("path", grid.save), ("path", rk.studies.Grid.load)):
        with pytest.raises(ValueError, match=f"Argument `{argument}` must be a path of a file system, but is '.*a"):
            use(path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", ["", "a\0b.zarr", 5, b"a.zarr", {}, None])
def test_what_is_no_path_is_refused(path, grid):
    uses = {"store": run, "path": grid.save} if isinstance(path, str) else {}  # the tests check other types themselves
    for argument, use in (uses | {"any": lambda path: local("any", path)}).items():
        with pytest.raises(ValueError, match=f"Argument `{argument}` must be a path, but is"):
            use(path)


@pytest.mark.parametrize(
    "results, message",
    [
        ({"a.b": 1.0, "a": {"b": 2.0}}, "two are called 'a.b'"),
        ({"a": {"b": {"c": 1.0}, "b.c": 2.0}}, "two are called 'a.b.c'"),
        ({"x": 1.0}, "other names than the axes .* two are called 'x'"),
        ({"point": 1.0}, "two are called 'point'"),
        ({"a": np.zeros(3), "a.0": 1.0}, "two are called 'a.0'"),
        ({"jaxrock_blocks": 1.0}, "two are called 'jaxrock_blocks'"),
        ({"a/b": 1.0}, "one is 'a/b'"),
        ({"a": {"/b": 1.0}}, "one is 'a./b'"),
        ({"": 1.0, "..": 2.0}, "one is '..'"),
        ({"__a": 1.0}, "one is '__a'"),
        ({"zarr.json": 1.0}, "one is 'zarr.json'"),
        ({"a\n": 1.0}, r"one is 'a\\n'"),
        ({"a" * 300: 1.0}, "one is 'aaa"),
    ],
)
def test_names_that_are_no_names_of_their_own_are_refused(tmp_path, results, message):
    """By one rule: in sweeps, in xarray and in files."""
    side_by_side = {"outer": False, "progress": False}
    with pytest.raises(ValueError, match=message):
        rk.sweep(lambda x: jax.tree.map(lambda value: value * x, results), x=[1.0, 2.0], **side_by_side)
    values = jax.tree.map(lambda value: np.broadcast_to(value, (2, *np.shape(value))), results)
    grid = rk.studies.Grid({"x": np.arange(2.0)}, values, False)
    for use in (grid.to_xarray, lambda: grid.save(tmp_path / "a.nc"), lambda: grid.save(tmp_path / "a.zarr")):
        with pytest.raises(ValueError, match=message):
            use()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_other_names_come_back(tmp_path, ending):
    values = {"Sa(0.5 s)": np.arange(2.0), "α": {"β": np.arange(2)}, "a.b": np.array([True, False])}
    grid = rk.studies.Grid({"x y": np.arange(2.0)}, values)
    grid.save(tmp_path / f"a{ending}")
    again = rk.studies.Grid.load(tmp_path / f"a{ending}")
    assert set(again.values) == {"Sa(0.5 s)", "α.β", "a.b"} and damage.bits(again) == damage.bits(grid)


@pytest.mark.parametrize("ending, bad", [(".nc", [1j, np.float16(1)]), (".zarr", ["text"])])
def test_what_a_format_does_not_take_is_refused(tmp_path, ending, bad):
    for value in bad:
        with pytest.raises(ValueError, match="'?`?odd'?`?"):
            rk.studies.Grid({"x": np.arange(2.0)}, {"odd": np.array([value, value])}).save(tmp_path / f"a{ending}")
    assert not list(tmp_path.iterdir())


def test_a_description_is_told_from_one_that_was_changed(store):
    """Check that a description edited by hand is detected."""
    text = json.loads((store / "zarr.json").read_text())
    text["attributes"]["jaxrock_store"] = text["attributes"]["jaxrock_store"].replace('"block": [2', '"block": [3')
    (store / "zarr.json").write_text(json.dumps(text))
    with pytest.raises(ValueError, match=f"is damaged: {store / 'zarr.json'}"):
        rk.studies.Grid.load(store)


def test_the_table_of_promises_names_tests_that_are_there():
    tests = Path(__file__).parent
    text = (tests.parent / "docs" / "crashes.md").read_text()
    named = re.findall(r"`(?:(test_\w+\.py)::)?(test_\w+)`", text)
    assert len(named) > 25
    for file, name in named:
        assert f"def {name}(" in (tests / (file or "test_crashes.py")).read_text(), name


def test_files_reach_the_disk_where_that_takes_a_right_to_write(tmp_path, monkeypatch):
    """As it does on Windows, which flushes no file that was opened for reading."""
    (tmp_path / "file").write_text("whole")
    opened, flags = os.open, []
    with monkeypatch.context() as there:
        there.setattr(os, "name", "nt")
        there.setattr(os, "open", lambda path, flag: flags.append(flag) or opened(path, flag))
        _reach_the_disk(tmp_path / "file")
    assert flags == [os.O_RDWR]
