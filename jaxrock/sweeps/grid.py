"""Results over labelled axes, their files, and their conversion to xarray and pandas."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Shaped

from jaxrock._arguments.tables import is_status, items_of, needed
from jaxrock._core.atomic_files import uninterrupted, written_atomically
from jaxrock.sweeps import netcdf
from jaxrock.sweeps.description import fingerprint
from jaxrock.sweeps.labels import POINT, dimensions, layout_name, names_of, numbered, own_names, shape_of
from jaxrock.sweeps.plan import Plan
from jaxrock.sweeps.store import create, local, opened

if TYPE_CHECKING:
    import pandas
    import xarray


class Grid(eqx.Module):
    """Results of a sweep over labelled axes.

    - `axes`: values of every axis by name; of one along a suite, the names of its motions.
    - `values`: the function's results, an `Outcome` or any pytree, as NumPy arrays in host memory. The first axes of
      every array are those of the grid, in their order; one axis if the axes went side by side.
    - `outer`: whether the points are the outer product of the axes; else the axes go side by side.
    - `resumed`: number of points that a store already held.
    """

    axes: dict[str, Shaped[np.ndarray, " n"]]
    values: Any
    outer: bool = eqx.field(static=True, default=True)
    resumed: int = eqx.field(static=True, default=0)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points along every axis; one number if the axes went side by side."""
        return shape_of(self.axes.values(), self.outer)

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name}: {np.size(values)}" for name, values in self.axes.items())
        return f"Grid({layout_name(self.outer)}, {sizes}; {', '.join(names_of(self.values))})"

    def to_xarray(self) -> "xarray.Dataset":
        """Convert the results to an `xarray.Dataset`: one variable for each result, the axes as coordinates.

        **Returns:** the dataset; `status` is a number there, the position of its message in `Status`.

        **Raises:** ImportError without xarray; ValueError where two of axes, results and dimensions have one name, or a
        name that files cannot have.
        """
        xarray = needed("xarray")
        variables = {
            name: (dimensions(self.axes, self.outer, name, np.ndim(leaf) - len(self.shape)), leaf)
            for name, leaf in self._leaves().items()
        }
        coordinates = {
            name: ((name,) if self.outer else (POINT,), np.asarray(values)) for name, values in self.axes.items()
        }
        return xarray.Dataset(variables, coordinates, {"layout": layout_name(self.outer)})

    def to_pandas(self) -> "pandas.DataFrame":
        """Convert the results to a `pandas.DataFrame` indexed by the axes: a column for each result, a status in words.

        **Raises:** as `to_xarray`; ImportError without pandas.
        """
        pandas = needed("pandas")
        frame = self.to_xarray().to_dataframe()
        for path, part in jax.tree_util.tree_leaves_with_path(self.values, is_leaf=is_status):
            if is_status(part):
                name = jax.tree_util.keystr(path, simple=True, separator=".") or "value"
                frame[name] = pandas.Categorical.from_codes(frame[name], items_of(part))
        return frame

    def _leaves(self) -> dict[str, np.ndarray]:
        """Return results by names that files can have."""
        names = own_names(list(self.axes), self.outer, self.values, len(self.shape))
        found = {name: np.asarray(leaf) for name, leaf in zip(names, jax.tree.leaves(self.values))}
        for name, leaf in found.items():
            if leaf.shape[: len(self.shape)] != self.shape:
                raise ValueError(f"The result {name!r} must begin with shape {self.shape}, but has {leaf.shape}.")
        return found

    def save(self, path: str | Path) -> None:
        """Write the results to a new file, completely or not at all, with checksums that `load` verifies.

        **Arguments:**

        - `path`: ends with .nc for NetCDF, with .zarr for Zarr. No value is marked as missing: xarray reads every
          number as it is, in its own type.

        **Raises:** ValueError for another ending, for object stores (`s3://...`), and for results with names that files
        cannot have; FileExistsError; OSError where it cannot be written, such as on a full disk, without leaving a part
        of it; ImportError without xarray, h5netcdf or zarr.
        """
        write = {".nc": self._to_netcdf, ".zarr": self._to_zarr}
        path = local("path", path)
        if path.suffix not in write:
            raise ValueError(f"Argument `path` must end with .nc or .zarr, but is {str(path)!r}.")
        if path.exists():
            raise FileExistsError(f"Argument `path` must be a new file, but {path} exists.")
        try:
            write[path.suffix](path)
        except FileExistsError:
            raise
        except OSError as error:
            raise OSError(error.errno, f"{error.strerror or error}. Nothing was saved", str(path)) from error

    def _to_netcdf(self, path: Path) -> None:
        for name, leaf in (numbered(self.axes)[0] | self._leaves()).items():
            if leaf.dtype.kind not in "biuf" or leaf.dtype == np.float16:
                raise ValueError(f"NetCDF has no {leaf.dtype}, which {name!r} is: take a path that ends with .zarr.")
        stopped = threading.Event()
        uninterrupted(netcdf.write_dataset, self.to_xarray(), path, stopped, stop=stopped.set)

    def _to_zarr(self, path: Path) -> None:
        axes, words = numbered({name: _in_order(np.asarray(values)) for name, values in self.axes.items()})
        leaves = self._leaves()
        plan = Plan.of(tuple(axes.values()), self.outer)
        like = {name: jax.ShapeDtypeStruct(x.shape[len(self.shape) :], x.dtype) for name, x in leaves.items()}
        made_by, stopped = fingerprint(axes, self.outer, "saved results", words), threading.Event()

        def written():
            with written_atomically(path) as aside:
                store = create(aside, axes, self.outer, like, plan.block, made_by, words, whole=True)
                for number in range(store.count):
                    if stopped.is_set():
                        raise InterruptedError
                    store.write(number, [leaf[plan.place(number)] for leaf in leaves.values()])

        uninterrupted(written, stop=stopped.set)

    @classmethod
    def load(cls, path: str | Path) -> "Grid":
        """Read saved results, or the store of a finished sweep; all checksums are verified.

        **Arguments:**

        - `path`: as in `save`, or a store.

        **Returns:** a `Grid`. Values are an `Outcome` again, or a dictionary by names.

        **Raises:** ValueError for a store that is not finished, and for a damaged file, with its path;
        FileNotFoundError; ImportError without xarray, h5netcdf or zarr.
        """
        path = local("path", path)
        if path.is_dir():
            store = opened(path)
            return cls(store.axes(), _rebuilt(dict(zip(store.names, store.read()))), store.outer)
        with netcdf.opened_dataset(path) as data:
            axes = {str(name): _known(np.asarray(values)) for name, values in data.coords.items()}
            values = {str(name): np.asarray(values) for name, values in data.data_vars.items()}
            return cls(axes, _rebuilt(values), data.attrs["layout"] == layout_name(True))


_examples: list[Callable[[], Any]] = []


def known_again(example: Callable[[], Any]) -> None:
    """Register a kind of results that `Grid.load` rebuilds: a file keeps only the names of their arrays.

    **Arguments:**

    - `example`: makes a result of this kind with arbitrary numbers; called when a file is loaded.
    """
    _examples.append(example)


def _in_order(values: np.ndarray) -> np.ndarray:
    """Return values in this machine's byte order, as stores hold them."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _known(values: np.ndarray) -> np.ndarray:
    """Return an axis of a file; files hold words as objects."""
    return values.astype(str) if values.dtype.kind == "O" else values


def _rebuilt(values: dict[str, np.ndarray]) -> Any:
    """Rebuild results of a registered kind if their names match; else return the dictionary."""
    for example in _examples:
        like = example()
        names = names_of(like)
        if set(names) == set(values):
            return jax.tree.unflatten(jax.tree.structure(like), [values[name] for name in names])
    return values
