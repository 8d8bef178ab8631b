"""Sweeps over labelled axes: points in blocks of few compiled shapes, over devices, processes and interruptions.

There are three sizes:

- A *chunk* of neighbours steps together on one core (see `lanes`).
- A *batch* of chunks, dealt to the devices in turn, is one compiled call.
- A *block* of batches is a tile of the grid. It is computed, written to a store, and dealt to a process as a whole.

A point's result depends on no other point, so it is the same however points are dealt.
"""

import math
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._arguments.tables import needed
from jaxrock._core.arrays import check_unmasked, in_native_bytes, is_traced, shown, to_device
from jaxrock._core.atomic_files import uninterrupted
from jaxrock._core.named import AbstractNamed
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.progress import Progress
from jaxrock.compiler import trace_function
from jaxrock.sweeps.description import fingerprint
from jaxrock.sweeps.devices import all_or_none, exchange, process, shared_out
from jaxrock.sweeps.grid import Grid
from jaxrock.sweeps.labels import own_names
from jaxrock.sweeps.plan import Plan, tiles
from jaxrock.sweeps.runner import Runner
from jaxrock.sweeps.store import Store, listed, local, made_or_mended, of_sweep


@overload
def sweep(
    function: Callable,
    /,
    *,
    outer: bool = ...,
    store: str | Path | None = ...,
    load: Literal[True] = ...,
    block: int | None = ...,
    progress: bool | None = ...,
    version: str | None = ...,
    **axes: ArrayLike | Sequence[float | int] | AbstractNamed,
) -> Grid: ...


@overload
def sweep(
    function: Callable,
    /,
    *,
    outer: bool = ...,
    store: str | Path,
    load: bool,
    block: int | None = ...,
    progress: bool | None = ...,
    version: str | None = ...,
    **axes: ArrayLike | Sequence[float | int] | AbstractNamed,
) -> Grid | None: ...


@arguments
def sweep(
    function: Callable,
    /,
    *,
    outer: bool = True,
    store: str | Path | None = None,
    load: bool = True,
    block: Annotated[int | None, at_least(1)] = None,
    progress: bool | None = None,
    version: str | None = None,
    **axes: ArrayLike | Sequence | AbstractNamed,
) -> Grid | None:
    """Evaluate a function at every point of labelled axes, on all devices, and on all machines of a job.

    **Arguments:**

    - `function`: called with one number for every axis, by name; returns an `Outcome` or any pytree of arrays. It is
      traced, as under `jax.vmap`.
    - `axes`: (n,) values of each axis, at least one, by any name but those of the other arguments. Neighbours along the
      last axis are computed together. An axis may be a `Suite`: the function gets its motions, which share their
      samples, and their names are the axis.
    - `outer`: every combination of the axes (default), or the axes side by side, all of one length.
    - `store`: path of a Zarr store, which keeps finished blocks. A killed sweep continues from them when it is called
      again. Existing files are first verified against their checksums; a warning names damaged ones, whose contents are
      computed again. All processes of a job use the same path. Needs `pip install "jaxrock[store]"`.
    - `load`: whether to return the results. They can stay in the store if they exceed the memory.
    - `block`: number of points that are computed, written and dealt to a process at a time; None: chosen between 65,536
      and 262,144. Besides the results, memory is needed for one block. A killed job loses one block per process.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.
    - `version`: identifies the function in a store, besides its traced program. It is required for a function that
      calls back to Python (`jax.pure_callback`), whose program does not show what is computed.

    **Returns:** a `Grid`, the same in every process; None if the results stay in the store.

    **Raises:** ValueError for axes that are not lists of numbers, for values that the function refuses, for results
    without names of their own, for a store of another sweep, or one that is no path of a file system (`s3://...`);
    OSError where the store cannot be written, for example on a full disk; RuntimeError in a job of many processes for a
    second sweep at a time, and for a failure in another process; ImportError for a store without zarr.
    """
    if not axes:
        raise ValueError("A sweep needs at least one axis, such as `p=[1.0, 2.0]`.")
    path = None if store is None else local("store", store)
    if path is None and not load:
        raise ValueError("Argument `load` must be True where there is no `store`.")
    suites = {name: values for name, values in axes.items() if isinstance(values, AbstractNamed)}
    words = {name: suite.names for name, suite in suites.items()}
    given: dict[str, Any] = axes | {name: np.arange(len(names)) for name, names in words.items()}
    lists = {name: _axis(name, values) for name, values in given.items()}
    if not outer and len({values.size for values in lists.values()}) > 1:
        sizes = ", ".join(f"{name} has {values.size}" for name, values in lists.items())
        raise ValueError(f"Axes that go side by side must have one length, but {sizes}.")

    order = tuple(axes)

    def at_point(*point):
        return function(**dict(zip(order, point)))

    def at_suites(*point):
        return at_point(*(suites[name][x] if name in suites else x for name, x in zip(order, point)))

    like = [jax.ShapeDtypeStruct((), values.dtype) for values in lists.values()]
    traced: Any = trace_function(at_suites if suites else at_point, *like)
    names = own_names(list(axes), outer, traced.results, 0)
    plan = Plan.of(tuple(lists.values()), outer, block)
    with shared_out():
        keeper = None
        if path is not None:
            if version is None and traced.calls_back:
                raise ValueError(
                    "Argument `version` must be given for a function that calls back to Python: a store cannot tell "
                    "whether what it calls has changed."
                )
            leaves = dict(zip(names, jax.tree.leaves(traced.results)))
            keeper = _keeper(path, plan, lists, words, leaves, traced.fingerprint, version)
            plan = plan._replace(block=keeper.block)
        values, resumed = compute(_at_point, plan, traced, "sweep", progress, store=keeper, load=load)
    labels = {name: np.array(words[name]) if name in words else values for name, values in lists.items()}
    return Grid(labels, values, outer, resumed) if load else None


def _at_point(*point_and_traced):
    *point, traced = point_and_traced
    return traced(*point)


def _keeper(
    path: Path,
    plan: Plan,
    axes: dict[str, np.ndarray],
    words: dict[str, tuple[str, ...]],
    leaves: dict,
    program: str,
    version: str | None,
) -> Store:
    """Open the store at a path in every process; the first process makes or mends it."""
    needed("zarr")  # raises in every process before the first of them makes a file
    made_by = fingerprint(axes, plan.outer, program, words)
    if version is not None:
        made_by["argument `version`"] = str(version)
    damaged = []
    with all_or_none():
        if process()[0] == 0:
            damaged = made_or_mended(path, axes, plan.outer, leaves, plan.block, made_by, words)
    with all_or_none():
        store = of_sweep(path, made_by)
    store.mended += damaged
    return store


def _there(store: Store) -> np.ndarray:
    """Return whether every block of a store is finished: each is verified by one process, which shares the result.

    Damaged files are named in a warning, and their blocks count as missing.
    """
    own, count = process()
    found = np.zeros(store.count, np.uint8)
    damaged = []
    with all_or_none():
        for number in (each for each in store.begun() if each % count == own):
            good, files = store.look(number)
            damaged += files
            found[number] = 2 if files else good
    if count > 1:
        found = exchange(found).max(axis=0)
    with all_or_none():
        others = [number for number in np.flatnonzero(found == 2) if number % count != own]
        damaged += [file for number in others if own == 0 for file in store.look(int(number))[1]]
        if own == 0 and (files := store.mended + damaged):
            warnings.warn(
                f"The store {store.path} is damaged: {listed(files)}. What these held is computed again.",
                stacklevel=frames_of_the_package() + 1,
            )
    return found == 1


def _axis(name: str, values: ArrayLike | Sequence) -> np.ndarray:
    check_unmasked(name, values)
    try:
        array = np.asarray(values)
    except ValueError as error:  # lists of unlike lengths
        raise ValueError(f"Argument `{name}` must be a list of numbers, but is {shown(values)}.") from error
    whole = [value for value in values if isinstance(value, int)] if isinstance(values, (list, tuple)) else []
    if array.ndim == 1 and len(whole) == array.size > 0 and array.dtype.kind in "fO":
        largest = max(whole, key=abs)
        raise ValueError(f"Argument `{name}` must be whole numbers of one type of 64 bits, but has {largest}.")
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"Argument `{name}` must be a list of at least one number, but has shape {array.shape} and type "
            f"{array.dtype}."
        )
    with np.errstate(over="ignore", under="ignore"):
        found = in_native_bytes(array)
        found = found.astype(jax.dtypes.canonicalize_dtype(found.dtype))  # in the precision of the session
    if array.dtype.kind in "iu" and (found != array).any():
        raise ValueError(
            f"Argument `{name}` must be whole numbers of the precision of the session ({found.dtype}), but has "
            f"{array[found != array][0]}: enable double precision, or give them as floats."
        )
    if array.dtype.kind == "f":
        _check_size(name, array, found)
    return found


def _check_size(name: str, given: np.ndarray, found: np.ndarray) -> None:
    """Refuse numbers that become infinite or zero in the precision of the session.

    Processors take subnormal numbers as zero.
    """
    known = np.finfo(found.dtype)
    bad = (np.isinf(found) & ~np.isinf(given)) | ((np.abs(found) < known.tiny) & (given != 0))
    if bad.any():
        raise ValueError(
            f"Argument `{name}` must be numbers of the precision of the session ({found.dtype}: 0, or from "
            f"{known.tiny:.2g} to {known.max:.2g} in size), but has {given[bad][0]!s}: take another unit"
            f"{'' if found.dtype == np.float64 else ', or enable double precision'}."
        )


def surface(
    function: Callable,
    axes: tuple,
    scene,
    label: str,
    progress: bool | None,
    outer: bool = True,
    columns: bool = False,
    names: tuple[str, ...] | None = None,
):
    """Evaluate `function(*point, scene)` over valid axes; return JAX arrays with the shape of the grid in front.

    `columns`: neighbours along the last axis but one are computed together. `names`: keys to keep of a dictionary of
    results.

    Within `jax.jit`, `jax.vmap` or a derivative it is the plain function of arrays, on the device that JAX chooses.
    """
    traced = is_traced((axes, scene))
    if traced:
        results = _traced_surface(function, tuple(map(jnp.asarray, axes)), scene, outer)
    else:
        results = known_surface(function, axes, scene, label, progress, outer, columns)
    wanted = results if names is None else {name: results[name] for name in names}
    return wanted if traced else to_device(wanted)


def known_surface(
    function: Callable, axes: tuple, scene, label: str, progress: bool | None, outer: bool = True, columns: bool = False
):
    """Evaluate `surface` for concrete arguments; return NumPy arrays."""
    plan = Plan.of(tuple(np.asarray(values) for values in axes), outer)
    return compute(function, plan, scene, label, progress, columns=columns)[0]


def _traced_surface(function: Callable, axes: tuple, scene, outer: bool):
    points = jnp.meshgrid(*axes, indexing="ij") if outer else axes
    results = jax.vmap(lambda *point: function(*point, scene))(*(x.ravel() for x in points))
    return jax.tree.map(lambda x: x.reshape(*points[0].shape, *x.shape[1:]), results)


@shared_out()
def compute(
    function: Callable,
    plan: Plan,
    scene,
    label: str,
    progress: bool | None,
    *,
    store: Store | None = None,
    load: bool = True,
    columns: bool = False,
) -> tuple[Any, int]:
    """Evaluate `function(*point, scene)` on a grid; return NumPy arrays, and the number of points from a store.

    With many processes each computes its share of the blocks, in turn; every process returns all results.
    """
    run = Runner(function, plan.axes, scene, math.prod(plan.block), math.prod(plan.shape))
    own, count = process()
    if store is None and count == 1 and plan.block == plan.shape:
        return _at_once(run, plan, label, progress, columns), 0
    done = _there(store) if store else np.zeros(math.prod(plan.blocks), bool)
    left = np.flatnonzero(~done).tolist()
    mine = left[own::count]
    resumed = int(plan.sizes[done].sum())
    if store and resumed and own == 0 and progress is not False:
        print(f"{label}: {resumed:,} of {math.prod(plan.shape):,} points come from {store.path}", file=sys.stderr)
    bar = Progress(int(plan.sizes[mine].sum()), label, progress if own == 0 else False)
    results = [] if store else [np.empty((*plan.shape, *x.shape), x.dtype) for x in run.shapes]

    with all_or_none():
        if store and own == 0:
            _mark(store, "unfinished" if left else "finished")
        for number in mine:
            place = plan.place(number)
            shape = tuple(p.stop - p.start for p in place)
            leaves = run(plan.points(number), bar.add, tiles(shape, columns))
            leaves = [leaf.reshape(*shape, *leaf.shape[1:]) for leaf in leaves]
            if store:
                _write(store, number, leaves)
            else:
                for leaf, part in zip(results, leaves):
                    leaf[place] = part
    with all_or_none():  # wait until all processes have written their blocks
        if store and own == 0:
            _mark(store, "finished")
    if count > 1 and not store:
        _gather(results, plan, left)
    if store and not load:
        return None, resumed
    return jax.tree.unflatten(run.tree, store.read() if store else results), resumed


def _at_once(run: Runner, plan: Plan, label: str, progress: bool | None, columns: bool):
    """Compute a grid of one block, in a job of one process without a store."""
    bar = Progress(math.prod(plan.shape), label, progress)
    leaves = run(plan.points(0), bar.add, tiles(plan.shape, columns))
    return jax.tree.unflatten(run.tree, [leaf.reshape(*plan.shape, *leaf.shape[1:]) for leaf in leaves])


def _write(store: Store, number: int, leaves: list[np.ndarray]) -> None:
    _kept(store, store.write, number, leaves)


def _mark(store: Store, state: str) -> None:
    _kept(store, store.mark, state)


def _kept(store: Store, write: Callable, *given) -> None:
    """Write to a store; a raised error says that finished blocks are kept."""
    try:
        uninterrupted(write, *given)
    except OSError as error:
        said = f"{error.strerror or error}. Blocks that are finished are kept: the same sweep goes on from there"
        raise OSError(error.errno, said, str(store.path)) from error


def _gather(results: list[np.ndarray], plan: Plan, numbers: list[int]) -> None:
    """Give every process the blocks of all, in rounds of one block per process."""
    own, count = process()
    largest = sum(math.prod(plan.block) * leaf.itemsize * math.prod(leaf.shape[len(plan.shape) :]) for leaf in results)
    for begin in range(0, len(numbers), count):
        dealt = numbers[begin : begin + count]
        message = np.zeros(largest, np.uint8)
        if own < len(dealt):
            parts = [np.ravel(leaf[plan.place(dealt[own])]).view(np.uint8) for leaf in results]
            told = np.concatenate(parts)
            message[: told.size] = told
        for number, told in zip(dealt, exchange(message)):
            place, at = plan.place(number), 0
            for leaf in results:
                part = leaf[place]
                leaf[place] = told[at : at + part.nbytes].copy().view(leaf.dtype).reshape(part.shape)
                at += part.nbytes
