"""Results over labelled axes, and their way into files and xarray."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Num

POINT = "point"  # the one dimension of axes that go side by side


class Grid(eqx.Module):
    """Results of a sweep over labelled axes.

    - `axes`: values of every axis by name.
    - `values`: what the function returns, an `Outcome` or any pytree, as NumPy arrays in host memory. The first axes
      of every array are those of the grid, in their order; one axis if they went side by side.
    - `outer`: whether the points are the outer product of the axes; else the axes go side by side.
    - `resumed`: how many points had been computed before, and came from a store.
    """

    axes: dict[str, Num[np.ndarray, " n"]]
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

    def to_xarray(self):
        """The results as an `xarray.Dataset`: one variable for each result, the axes as coordinates.

        **Returns:** the dataset; `status` is a number there, the position of its message in `Status`.

        **Raises:** ImportError without xarray.
        """
        xarray = needed("xarray")
        variables = {
            name: (dimensions(self.axes, self.outer, name, np.ndim(leaf) - len(self.shape)), np.asarray(leaf))
            for name, leaf in zip(names_of(self.values), jax.tree.leaves(self.values))
        }
        coordinates = {
            name: ((name,) if self.outer else (POINT,), np.asarray(values)) for name, values in self.axes.items()
        }
        return xarray.Dataset(variables, coordinates, {"layout": layout_name(self.outer)})

    def save(self, path: str | Path) -> None:
        """Write the results to a new file.

        **Arguments:**

        - `path`: ends with .nc for NetCDF, with .zarr for Zarr.

        **Raises:** ValueError for another ending; FileExistsError; ImportError without xarray, h5netcdf or zarr.
        """
        kind = _kind(path)
        if Path(path).exists():
            raise FileExistsError(f"Argument `path` must be a new file, but {path} exists.")
        if kind == "zarr":
            needed("zarr")
            self.to_xarray().to_zarr(path, mode="w-", consolidated=False)
        else:
            needed("h5netcdf")
            self.to_xarray().to_netcdf(path, engine="h5netcdf")

    @classmethod
    def load(cls, path: str | Path) -> "Grid":
        """Read results that were saved, or the store of a sweep that has finished.

        **Arguments:**

        - `path`: as in `save`, or a store.

        **Returns:** a `Grid`. Values are an `Outcome` again, or a dictionary by names.

        **Raises:** ValueError for a store that is not finished; ImportError without xarray.
        """
        xarray = needed("xarray")
        if Path(path).is_dir():
            needed("zarr")
            opened = xarray.open_dataset(path, engine="zarr", chunks=None, consolidated=False)
        else:
            needed("h5netcdf")
            opened = xarray.open_dataset(path, engine="h5netcdf")
        with opened as data:
            if FINISHED in data:
                done = np.asarray(data[FINISHED])
                if not done.all():
                    raise ValueError(
                        f"The store {path} is not finished: {done.sum()} of {done.size} blocks. Run the same sweep "
                        "with it again."
                    )
                data = data.drop_vars(FINISHED)
            axes = {str(name): np.asarray(values) for name, values in data.coords.items()}
            values = {str(name): np.asarray(values) for name, values in data.data_vars.items()}
            return cls(axes, _rebuilt(values), data.attrs["layout"] == layout_name(True))


FINISHED = "finished"  # the array of a store that tells which blocks are done


def shape_of(axes: Iterable[np.ndarray], outer: bool) -> tuple[int, ...]:
    """Shape of the grid that axes span."""
    sizes = tuple(np.size(values) for values in axes)
    return sizes if outer else sizes[:1]


def layout_name(outer: bool) -> str:
    """How files call it."""
    return "outer" if outer else "side by side"


def dimensions(axes: dict[str, np.ndarray], outer: bool, name: str, more: int) -> tuple[str, ...]:
    """Names of the dimensions of a result that has some more than the grid."""
    return (*(axes if outer else (POINT,)), *(f"{name}.{k}" for k in range(more)))


def names_of(values: Any) -> list[str]:
    """A name for every array of a pytree: its path, such as `max_rotation` or `outcome.status`."""
    paths = [
        jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in jax.tree_util.tree_leaves_with_path(values)
    ]
    return [path.removesuffix("._value") or "value" for path in paths]


def needed(module: str):
    """Import a module of the extra `store`, or say how to get it."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f'This needs {module}: `pip install "jaxrock[store]"`.') from error


def _kind(path: str | Path) -> str:
    kind = {".nc": "netcdf", ".zarr": "zarr"}.get(Path(path).suffix)
    if kind is None:
        raise ValueError(f"Argument `path` must end with .nc or .zarr, but is {str(path)!r}.")
    return kind


_examples: list[Callable[[], Any]] = []


def known_again(example: Callable[[], Any]) -> None:
    """Let `Grid.load` give results of a kind back as what they were: a file keeps their names only.

    **Arguments:**

    - `example`: makes one of this kind, with numbers of any values; called when something is loaded.
    """
    _examples.append(example)


def _rebuilt(values: dict[str, np.ndarray]) -> Any:
    """Results of a kind that is known, if the names are its; else the dictionary."""
    for example in _examples:
        like = example()
        names = names_of(like)
        if set(names) == set(values):
            return jax.tree.unflatten(jax.tree.structure(like), [values[name] for name in names])
    return values
