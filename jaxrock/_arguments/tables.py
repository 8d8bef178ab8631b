"""Results as tables for xarray and pandas, with names and units, and a status as words."""

import abc
import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxrock._arguments.repr import described

if TYPE_CHECKING:
    import pandas
    import xarray


class Column(NamedTuple):
    """A column of a table: values, names of their dimensions, and unit."""

    dimensions: tuple[str, ...]
    values: Any
    unit: str = "-"


class AbstractTable(eqx.Module):
    """A result with `_columns` by name; a column with the name of its only dimension is a coordinate."""

    __repr__ = described

    @property
    @abc.abstractmethod
    def _columns(self) -> dict[str, Column]:
        """Return all columns; those whose values are None are left out."""

    def to_xarray(self) -> "xarray.Dataset":
        """Return the result as an `xarray.Dataset`: units are attributes, a status is the name of its item.

        **Raises:** ImportError without xarray.
        """
        xarray = needed("xarray")
        columns = {name: column for name, column in self._columns.items() if column.values is not None}
        told = {
            name: xarray.Variable(column.dimensions, _plain(column.values), {"units": column.unit})
            for name, column in columns.items()
        }
        own = {name: told.pop(name) for name, column in columns.items() if column.dimensions == (name,)}
        return xarray.Dataset(told, own, attrs={"result": type(self).__name__})

    def to_pandas(self) -> "pandas.DataFrame":
        """Return the result as a `pandas.DataFrame`, indexed by its coordinates.

        A status is a category. `attrs["units"]` has the units by column.

        **Raises:** ImportError without xarray, or pandas.
        """
        needed("pandas")
        table = self.to_xarray()
        frame = table.to_dataframe() if table.dims else table.expand_dims("row").to_dataframe()
        for name, column in self._columns.items():
            if name in frame and is_status(column.values):
                frame[name] = frame[name].astype("category")
        frame.attrs["units"] = {name: table[name].attrs["units"] for name in table.variables}
        return frame


def scenes(ndim: int) -> tuple[str, ...]:
    """Return names for the `ndim` axes that `jax.vmap` puts in front."""
    return ("scene",)[:ndim] if ndim < 2 else tuple(f"scene_{i}" for i in range(ndim))


def over_time(time, histories: dict[str, tuple[Any, str]]) -> dict[str, Column]:
    """Return columns of histories, each with its unit: along the time of one scene, or along the samples of many."""
    many = scenes(np.ndim(time) - 1)
    axes = (*many, "sample" if many else "time")
    told = {name: Column(axes, values, unit) for name, (values, unit) in histories.items()}
    return {"time": Column(axes, time, "s")} | told


def is_status(values: Any) -> bool:
    """Return whether values are a status, or an array of them."""
    return hasattr(values, "_enumeration")


def _plain(values: Any) -> np.ndarray:
    """Return values as a NumPy array; for a status, the names of items."""
    if not is_status(values):
        return np.asarray(values)
    return np.array(items_of(values))[np.asarray(values._value)]


def items_of(status: Any) -> list[str]:
    """Return the names of all items of a status' class, in the order of their numbers."""
    return list(status._enumeration._name_to_item)


def needed(module: str) -> ModuleType:
    """Import a module of the extra `store`. **Raises:** ImportError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f'This needs {module}: `pip install "jaxrock[store]"`.') from error
