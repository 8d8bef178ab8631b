"""Stores: a sweep that was interrupted goes on where it was, with the same bits; nothing else is taken for it."""

import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.sweeps.labels import RECORDS
from jaxrock.sweeps.store import Store

xarray, zarr = pytest.importorskip("xarray"), pytest.importorskip("zarr")
pytest.importorskip("h5netcdf")

AXES = {"alpha": np.linspace(0.1, 0.3, 9), "p": np.linspace(1.0, 3.0, 50)}


def wave(alpha, p):
    return {"sine": jnp.sin(alpha * p), "above": alpha > 0.2, "pair": jnp.stack([alpha, p])}


def run(function=wave, **options):
    return rk.sweep(function, **{"block": 100, "progress": False} | AXES | options)


@pytest.fixture(scope="module")
def straight():
    return run()


def same(one, other):
    assert one.axes.keys() == other.axes.keys() and one.outer == other.outer
    for name in one.axes:
        np.testing.assert_array_equal(one.axes[name], other.axes[name])
    for name, values in one.values.items():
        assert values.dtype == other.values[name].dtype
        np.testing.assert_array_equal(values, other.values[name])


class Killed(BaseException):
    """Nothing that the code could catch."""


class Deadly:
    """An array that takes nothing any more."""

    def __setitem__(self, place, leaf):
        raise Killed


@pytest.fixture
def written(monkeypatch):
    """The blocks that are written, and at which to die: between its first array and its second."""
    blocks, write, kill_at = [], Store.write, []

    def noting(self, number, leaves):
        if len(blocks) in kill_at:
            kill_at.clear()
            self._arrays[1] = Deadly()
        write(self, number, leaves)
        blocks.append(number)

    monkeypatch.setattr(Store, "write", noting)
    return blocks, kill_at


@pytest.mark.parametrize("kill_at", [0, 1, 3])
def test_an_interrupted_sweep_goes_on(tmp_path, straight, written, capsys, kill_at):
    blocks, kills = written
    kills.append(kill_at)
    with pytest.raises(Killed):
        run(store=tmp_path / "a.zarr")
    again = run(store=tmp_path / "a.zarr", progress=None)
    same(straight, again)
    assert len(blocks) == len(set(blocks)) == 5  # nothing twice
    assert again.resumed == 100 * kill_at
    assert (f"{100 * kill_at} of 450 points come from" in capsys.readouterr().err) == (kill_at > 0)
    assert run(store=tmp_path / "a.zarr").resumed == 450 and len(blocks) == 5


def test_blocks_of_a_store_are_its_own(tmp_path, straight, written):
    """Whatever is asked for when it goes on."""
    written[1].append(2)
    with pytest.raises(Killed):
        run(store=tmp_path / "a.zarr")
    same(straight, run(store=tmp_path / "a.zarr", block=33))
    assert len(written[0]) == 5


@pytest.mark.parametrize(
    "change, message",
    [
        ({"p": np.linspace(1.0, 3.1, 50)}, "other axis `p`"),
        ({"function": lambda alpha, p: wave(alpha, 2 * p)}, "other function, or what it holds"),
        ({"function": lambda alpha, p: wave(alpha, p) | {"more": p}}, "other function"),
        ({"p": np.linspace(1.0, 3.0, 9), "outer": False}, "other axis `p`; other layout"),
        ({"alpha": AXES["alpha"].astype(np.float32)}, "other axis `alpha`"),
    ],
)
def test_a_store_of_another_sweep_is_refused(tmp_path, change, message):
    run(store=tmp_path / "a.zarr")
    with pytest.raises(ValueError, match=message):
        run(store=tmp_path / "a.zarr", **change)


def test_a_function_that_holds_other_numbers_is_another(tmp_path):
    held = [jnp.array([1.0, 2.0]), jnp.array([1.0, 3.0])]
    run(lambda alpha, p: jnp.sum(held[0]) * alpha * p, store=tmp_path / "a.zarr")
    with pytest.raises(ValueError, match="other function, or what it holds"):
        run(lambda alpha, p: jnp.sum(held[1]) * alpha * p, store=tmp_path / "a.zarr")


def test_order_and_version_count(tmp_path, monkeypatch):
    run(store=tmp_path / "a.zarr")
    with pytest.raises(ValueError, match="other order of the axes"):
        rk.sweep(wave, p=AXES["p"], alpha=AXES["alpha"], store=tmp_path / "a.zarr")
    monkeypatch.setattr("jaxrock.sweeps.description.cache.version_of", lambda name: f"{name} 0.0.0")
    with pytest.raises(ValueError, match="other version of jaxrock"):
        run(store=tmp_path / "a.zarr")


def test_what_is_no_store_is_refused(tmp_path):
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(ValueError, match="must be a new path or the store of a sweep, but .* is neither"):
        run(store=tmp_path / "a.zarr")


def test_every_process_says_what_a_store_needs(tmp_path, monkeypatch):
    """Not that the store which the first one could not make is none."""
    monkeypatch.setitem(sys.modules, "zarr", None)
    monkeypatch.setattr("jaxrock.sweeps.sweep.process", lambda: (1, 4))
    with pytest.raises(ImportError, match=r'pip install "jaxrock\[store\]"'):
        run(store=tmp_path / "a.zarr")


def test_results_may_stay_in_the_store(tmp_path, straight):
    assert run(store=tmp_path / "a.zarr", load=False) is None
    same(straight, rk.studies.Grid.load(tmp_path / "a.zarr"))
    with xarray.open_dataset(tmp_path / "a.zarr", engine="zarr", chunks=None, consolidated=False) as data:
        assert data["sine"].sel(p=AXES["p"][7]).dims == ("alpha",)
        np.testing.assert_array_equal(data["sine"][:, 7], straight.values["sine"][:, 7])


def test_an_unfinished_store_is_not_loaded(tmp_path, written):
    written[1].append(2)
    with pytest.raises(Killed):
        run(store=tmp_path / "a.zarr")
    with pytest.raises(ValueError, match="is not finished: 2 of 5 blocks"):
        rk.studies.Grid.load(tmp_path / "a.zarr")


def test_what_lies_beside_the_blocks_is_left_alone(tmp_path, straight):
    """A record of a block that the grid does not have."""
    store = tmp_path / "a.zarr"
    run(store=store)
    shutil.copytree(store / RECORDS / "c" / "0", store / RECORDS / "c" / "99")
    again = run(store=store)
    assert again.resumed == 9 * 50
    same(again, straight)


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
@pytest.mark.parametrize("outer", [True, False])
def test_grids_are_saved_and_loaded(tmp_path, ending, outer):
    axes = AXES if outer else {name: values[:9] for name, values in AXES.items()}
    grid = rk.sweep(wave, outer=outer, **axes)
    grid.save(tmp_path / f"a{ending}")
    same(grid, rk.studies.Grid.load(tmp_path / f"a{ending}"))
    with pytest.raises(FileExistsError, match="must be a new file"):
        grid.save(tmp_path / f"a{ending}")


def test_outcomes_come_back(tmp_path):
    grid = rk.sweep(_outcome, k=[0, 1])
    data = grid.to_xarray()
    assert set(data) >= {"max_rotation", "status"} and data["margin"].dims == ("k",)
    grid.save(tmp_path / "a.nc")
    again = rk.studies.Grid.load(tmp_path / "a.nc").values
    assert isinstance(again, rk.responses.Outcome)
    np.testing.assert_array_equal(again.status == rk.Status.undecided, [False, True])
    np.testing.assert_array_equal(again.impact_count, [0, 1])


def _outcome(k):
    x = 1.0 * k
    status = rk.Status.where(k == 1, rk.Status.undecided, rk.Status.successful)
    return rk.responses.Outcome(x, x, x, k, k, x > 0, x, x, x > 0, x, x, x, status)


def test_another_ending_is_refused():
    with pytest.raises(ValueError, match="must end with .nc or .zarr, but is 'a.txt'"):
        rk.sweep(wave, **AXES).save("a.txt")


@pytest.mark.parametrize("module", ["zarr", "xarray", "h5netcdf"])
def test_a_missing_package_says_how_to_get_it(monkeypatch, tmp_path, straight, module):
    monkeypatch.setitem(sys.modules, module, None)
    use = {"zarr": lambda: run(store=tmp_path / "a.zarr"), "xarray": straight.to_xarray}
    with pytest.raises(ImportError, match=rf'needs {module}: `pip install "jaxrock\[store\]"`'):
        use.get(module, lambda: straight.save(tmp_path / "a.nc"))()


def test_functions_that_call_back_need_a_version(tmp_path):
    """The program does not tell what they call; two of them may even print alike."""

    def calling(factor):
        def called(x):
            return np.asarray(factor * x)

        return lambda x: {
            "y": jax.pure_callback(called, jax.ShapeDtypeStruct((), x.dtype), x, vmap_method="sequential")
        }

    axis, path = np.arange(1.0, 5.0), tmp_path / "sweep.zarr"
    with pytest.raises(ValueError, match="Argument `version` must be given for a function that calls back to Python"):
        rk.sweep(calling(2.0), store=path, progress=False, x=axis)
    first = rk.sweep(calling(2.0), store=path, progress=False, version="twice", x=axis)
    np.testing.assert_array_equal(first.values["y"], 2 * axis)
    with pytest.raises(ValueError, match="argument `version`"):
        rk.sweep(calling(3.0), store=path, progress=False, version="three times", x=axis)
    np.testing.assert_array_equal(rk.sweep(calling(3.0), progress=False, x=axis).values["y"], 3 * axis)
