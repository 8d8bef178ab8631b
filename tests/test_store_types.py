"""Every type of number in every format: stored values are exact, also to xarray, and missing ones are NaN."""

import shutil
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.sweeps import description
from jaxrock.sweeps.store import Store

xarray = pytest.importorskip("xarray")
pytest.importorskip("zarr"), pytest.importorskip("h5netcdf")

NAN = np.array([0x7FF8000000000123], np.uint64).view(float)[0]  # with a payload
DEFAULT_FILL = 9.969209968386869e36  # fill values of NetCDF's floating-point numbers
REAL = [np.nan, np.inf, -np.inf, -0.0, DEFAULT_FILL, NAN]
WHOLE = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")


def of_whole(kind: str) -> np.ndarray:
    known, exact = np.iinfo(kind), 2**53  # as far as real numbers of 64 bits hold them
    return np.array([known.min, known.max, max(known.min + 1, -exact), min(known.max - 1, exact), 0, 1], kind)


TABLE = {kind: of_whole(kind) for kind in WHOLE} | {
    "bool": np.array([True, False, False, True, True, False]),
    "float16": np.array([np.nan, np.inf, -np.inf, -0.0, 65504.0, 6e-8], np.float16),
    "float32": np.array([*REAL[:5], 1e-45], np.float32),
    "float64": np.array(REAL),
    "complex64": np.array([1 + 2j, np.nan * 1j, np.inf, -0.0j, complex(0, np.nan), 3], np.complex64),
    "complex128": np.array([1 + 2j, np.nan * 1j, np.inf, -0.0j, complex(0, np.nan), 3]),
    "status": np.array([0, 1, 2, 3, 4, 0], np.int32),
    "zero_size": np.zeros((6, 0), np.int16),
    "pairs": np.stack([of_whole("uint8"), of_whole("uint8")[::-1]], axis=1),
}
IN_NETCDF = [name for name in TABLE if name != "float16" and not name.startswith("complex")]
AXIS = np.array([-128, -1, 0, 1, 126, 127], np.int8)
NUMBERS = np.arange(6)
DONE = 4  # computed points of the unfinished store


def function(k):
    return {name: jnp.asarray(values)[k] for name, values in TABLE.items()}


class Killed(BaseException):
    """An exception that the code cannot catch."""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return one file of each format with all types that it has."""
    folder, patch = tmp_path_factory.mktemp("types"), pytest.MonkeyPatch()
    paths = {name: folder / name for name in ("saved.nc", "saved.zarr", "finished.zarr", "unfinished.zarr")}
    rk.studies.Grid({"k": AXIS}, {name: TABLE[name] for name in IN_NETCDF}).save(paths["saved.nc"])
    rk.studies.Grid({"k": AXIS}, TABLE).save(paths["saved.zarr"])
    rk.sweep(function, k=NUMBERS, store=paths["finished.zarr"], block=2, progress=False)
    write = Store.write

    def killed(self, number, leaves):
        if number == DONE // 2:
            raise Killed
        write(self, number, leaves)

    patch.setattr(Store, "write", killed)
    with pytest.raises(Killed):
        rk.sweep(function, k=NUMBERS, store=paths["unfinished.zarr"], block=2, progress=False)
    patch.undo()
    return paths


def read_by_xarray(path: Path, name: str) -> np.ndarray:
    """Return values as users of xarray see them, by its default decoding."""
    engine = "h5netcdf" if path.suffix == ".nc" else "zarr"
    with xarray.open_dataset(path, engine=engine, chunks=None) as data:
        return data[name].values


def bits(values: np.ndarray) -> tuple:
    return values.dtype, values.shape, values.tobytes()


WRITTEN = [(name, "saved.nc") for name in IN_NETCDF]
WRITTEN += [(name, form) for form in ("saved.zarr", "finished.zarr") for name in TABLE]


@pytest.mark.parametrize("name, form", WRITTEN)
def test_finished_stores_are_exact(files, name, form):
    right = TABLE[name]
    assert bits(rk.studies.Grid.load(files[form]).values[name]) == bits(right)
    found = read_by_xarray(files[form], name)
    if form == "finished.zarr" and right.dtype.kind in "iu":  # in a wider type, where values may be missing
        assert found.dtype.kind == "i" or right.dtype == np.uint64
        found = found.astype(right.dtype)
    assert bits(found) == bits(right)


@pytest.mark.parametrize("name", TABLE)
def test_missing_values_are_nan_and_others_exact(files, name):
    right, found = TABLE[name], read_by_xarray(files["unfinished.zarr"], name)
    assert found.dtype.kind in "fc" and np.isnan(found[DONE:]).all()
    # Readers round 64-bit numbers beyond 2^53, and one number is the fill value.
    there = slice(2 if name.endswith("int64") else 0, DONE)
    np.testing.assert_array_equal(found[there], right[there])


def test_an_unfinished_store_goes_on_to_be_a_finished_one(files, tmp_path):
    path = tmp_path / "a.zarr"
    shutil.copytree(files["unfinished.zarr"], path)
    again = rk.sweep(function, k=NUMBERS, store=path, progress=False)
    assert again.resumed == DONE
    for name, right in TABLE.items():
        assert bits(again.values[name]) == bits(right)
        np.testing.assert_array_equal(read_by_xarray(path, name), right)


def test_a_block_that_is_lost_is_missing_again(files, tmp_path):
    """A finished store under repair is marked as unfinished for other readers."""
    path = tmp_path / "a.zarr"
    shutil.copytree(files["finished.zarr"], path)
    (path / "uint8" / "c" / "2").unlink()
    patch = pytest.MonkeyPatch()
    patch.setattr(Store, "write", lambda *given: (_ for _ in ()).throw(Killed))
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(Killed):
        rk.sweep(function, k=NUMBERS, store=path, progress=False)
    patch.undo()
    found = read_by_xarray(path, "uint8")
    assert np.isnan(found[4:]).all() and (found[:4] == TABLE["uint8"][:4]).all()
    with pytest.warns(UserWarning, match="is damaged"):
        rk.sweep(function, k=NUMBERS, store=path, progress=False)
    np.testing.assert_array_equal(read_by_xarray(path, "uint8"), TABLE["uint8"])


@pytest.mark.parametrize("files_written", range(0, 40, 7))
def test_a_session_may_end_while_a_store_is_marked(files, tmp_path, monkeypatch, files_written):
    """The marks of some arrays are still those of an unfinished store: no file counts as damaged."""
    path, count, written_atomically = tmp_path / "a.zarr", [], description.written_atomically
    shutil.copytree(files["unfinished.zarr"], path)

    def some(*given, **options):
        if len(count) == files_written:
            raise Killed
        count.append(1)
        return written_atomically(*given, **options)

    monkeypatch.setattr(description, "written_atomically", some)
    try:
        rk.sweep(function, k=NUMBERS, store=path, progress=False)
    except Killed:
        pass
    monkeypatch.undo()
    for name, values in rk.studies.Grid.load(path).values.items():
        assert bits(values) == bits(TABLE[name])
    assert rk.sweep(function, k=NUMBERS, store=path, progress=False).resumed == 6


@pytest.mark.parametrize("form", ["saved.nc", "saved.zarr"])
def test_axes_come_back(files, form):
    """Axes may hold the fill value of their type."""
    assert bits(rk.studies.Grid.load(files[form]).axes["k"]) == bits(AXIS)
    assert bits(read_by_xarray(files[form], "k")) == bits(AXIS)


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_numbers_in_another_order_of_bytes(tmp_path, ending):
    values = {"x": np.array([1.5, np.nan, 3.0], ">f8"), "n": np.array([1, 2, 300], ">i2")}
    rk.studies.Grid({"k": np.array([1, 2, 3], ">i4")}, values).save(tmp_path / f"a{ending}")
    again = rk.studies.Grid.load(tmp_path / f"a{ending}")
    np.testing.assert_array_equal(again.axes["k"], [1, 2, 3])
    for name, right in values.items():
        np.testing.assert_array_equal(again.values[name], right)


@pytest.mark.parametrize("name", ["old.zarr", "oldsaved.zarr"])
def test_stores_of_the_first_format_are_read(tmp_path, name):
    """Whole numbers and booleans with a fill value: a sweep's store and a saved grid."""
    with zipfile.ZipFile(Path(rk.__file__).parents[1] / "references" / "stores" / "marked_numbers.zip") as packed:
        packed.extractall(tmp_path)
    found, k, share = rk.studies.Grid.load(tmp_path / name), np.arange(9, 12)[:, None], np.array([0.5, 1.5])
    right = {
        "count": (5 * k + 200 + 0 * share).astype(np.uint8), "level": (-k - 100 + 0 * share).astype(np.int8),
        "safe": np.broadcast_to(k > 10, (3, 2)), "peak": share * k, "wide": k * 2**40 + np.zeros(2, int),
    }  # fmt: skip
    for each, values in right.items():
        assert bits(found.values[each]) == bits(values)
    assert jax.tree.map(np.ndarray.tolist, found.axes) == {"k": [9, 10, 11], "share": [0.5, 1.5]}
