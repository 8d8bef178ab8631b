"""Many scenes: points of labelled axes, in blocks of few compiled shapes, over devices, processes and interruptions.

Three sizes: a *chunk* of neighbours steps together on one core (see `lanes`); a *batch* of chunks, dealt to the devices
in turn, is one compiled call; a *block* of batches is a tile of the grid that is computed, written to a store, and
dealt to the processes as a whole. A point's result depends on nobody else's, so it is the same however they are dealt.
"""

import collections
import functools
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import ArrayLike

from jaxrock._checks import put_down
from jaxrock._progress import Progress
from jaxrock.devices import compiler_options, exchange, local_devices, meet, process
from jaxrock.grid import Grid, names_of, shape_of
from jaxrock.store import Store, create, fingerprint
from jaxrock.traced import Traced

_CHUNK = 64  # neighbours that are dealt to a device together
_TILE = 8  # and their extent along each of the last two axes of a grid
_ROWS = 4  # vmapped functions of up to 16,384 lanes (65,536 on a GPU) in one compiled call
_SMALLEST_BLOCK = 65536
_LARGEST_BLOCK = 2**18  # bounds the memory, whatever the size of the grid
_BLOCKS = 64  # of a grid, if it is large: what a killed job loses at most, and what is dealt to processes


def sweep(
    function: Callable,
    /,
    *,
    outer: bool = True,
    store: str | Path | None = None,
    load: bool = True,
    block: int | None = None,
    progress: bool | None = None,
    **axes: ArrayLike | Sequence,
) -> Grid | None:
    """Evaluate a function at every point of labelled axes, on all devices, and on all machines of a job.

    **Arguments:**

    - `function`: called with one number for every axis, by name; returns an `Outcome` or any pytree of arrays. It is
      traced, as under `jax.vmap`.
    - `axes`: (n,) values of each axis, at least one. Neighbours along the last axis are computed together.
    - `outer`: every combination of the axes (default), or the axes side by side, all of one length.
    - `store`: path of a Zarr store. Finished blocks are kept there: a sweep that was killed goes on where it was when
      it is called again. All processes of a job use the same path. Needs `pip install "jaxrock[store]"`.
    - `load`: whether to return the results. They can stay in the store, if they are too many for the memory.
    - `block`: points that are computed, written and dealt to a process at a time; None: as many as fit well, between
      65,536 and 262,144. Besides the results, memory is needed for one block. A killed job loses one block per process.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `Grid`, the same in every process; None if the results stay in the store.

    **Raises:** ValueError for axes that are not lists of numbers, for values that the function refuses, or for a store
    of another sweep; ImportError for a store without zarr.
    """
    if not axes:
        raise ValueError("A sweep needs at least one axis, such as `p=[1.0, 2.0]`.")
    if store is None and not load:
        raise ValueError("Argument `load` must be True where there is no `store`.")
    lists = {name: _axis(name, values) for name, values in axes.items()}
    if not outer and len({values.size for values in lists.values()}) > 1:
        sizes = ", ".join(f"{name} has {values.size}" for name, values in lists.items())
        raise ValueError(f"Axes that go side by side must have one length, but {sizes}.")
    if block is not None and block < 1:
        raise ValueError(f"Argument `block` must be at least 1, but is {block}.")

    traced = Traced(function, {name: jax.ShapeDtypeStruct((), values.dtype) for name, values in lists.items()})
    names = names_of(traced.shapes)
    if not names or set(names) & set(axes):
        raise ValueError(f"The function must return arrays with other names than the axes, but returns {names}.")
    plan = Plan.of(tuple(lists.values()), outer, block)
    keeper = None
    if store is not None:
        keeper = _keeper(store, plan, lists, traced)
        plan = plan._replace(block=keeper.block)
    values, resumed = compute(traced, plan, traced.constants, "sweep", progress, store=keeper, load=load)
    return Grid(lists, values, outer, resumed) if load else None


def _keeper(path: str | Path, plan: "Plan", axes: dict[str, np.ndarray], traced: Traced) -> Store:
    """The store at a path: made by the first process, if there is none; a sweep's own, in every process."""
    made_by = fingerprint(axes, plan.outer, traced.fingerprint)
    names, leaves = names_of(traced.shapes), jax.tree.leaves(traced.shapes)
    try:
        if process()[0] == 0 and not Path(path).exists():
            create(path, axes, plan.outer, names, leaves, plan.block, made_by)
    finally:
        meet()  # whatever became of it
    return Store(path, names, made_by)


def _axis(name: str, values: ArrayLike | Sequence) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"Argument `{name}` must be a list of at least one number, but has shape {array.shape} and type "
            f"{array.dtype}."
        )
    return np.asarray(jnp.asarray(array))  # in the precision of the session


def surface(
    function: Callable,
    axes: tuple,
    scene,
    label: str,
    progress: bool | None,
    outer: bool = True,
    columns: bool = False,
):
    """`function(*point, scene)` over axes that are known to be good; arrays of JAX, the shape of the grid in front.
    `columns`: neighbours along the last axis but one are computed together."""
    plan = Plan.of(tuple(np.asarray(values) for values in axes), outer)
    found = compute(function, plan, scene, label, progress, columns=columns)[0]
    return jax.tree.map(jnp.asarray, found)


class Plan(NamedTuple):
    """A grid of points and its blocks: tiles of `block` points along every axis, the last of an axis may be smaller."""

    axes: tuple[np.ndarray, ...]
    outer: bool
    block: tuple[int, ...]

    @classmethod
    def of(cls, axes: tuple[np.ndarray, ...], outer: bool, points: int | None = None) -> "Plan":
        """Blocks of about so many points: whole rows of the last axes, where they fit."""
        shape = shape_of(axes, outer)
        room = points or min(max(_SMALLEST_BLOCK, math.prod(shape) // _BLOCKS), _LARGEST_BLOCK)
        block = []
        for size in reversed(shape):
            parts = -(-size // max(room, 1))
            block.insert(0, -(-size // parts))  # parts of like size
            room //= block[0]
        return cls(axes, outer, tuple(block))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid."""
        return shape_of(self.axes, self.outer)

    @property
    def blocks(self) -> tuple[int, ...]:
        """Number of blocks along every axis."""
        return tuple(-(-size // part) for size, part in zip(self.shape, self.block))

    @property
    def sizes(self) -> np.ndarray:
        """Number of points of every block."""
        along = [np.minimum(part, n - part * np.arange(-(-n // part))) for n, part in zip(self.shape, self.block)]
        return functools.reduce(np.multiply.outer, along).ravel()

    def place(self, number: int) -> tuple[slice, ...]:
        """Where a block lies in the grid."""
        index = np.unravel_index(number, self.blocks)
        return tuple(slice(int(i) * p, min((int(i) + 1) * p, n)) for i, p, n in zip(index, self.block, self.shape))

    def points(self, number: int) -> list[np.ndarray]:
        """The flat points of a block."""
        place = self.place(number)
        if not self.outer:
            return [values[place[0]] for values in self.axes]
        parts = [values[part] for values, part in zip(self.axes, place)]
        return [x.ravel() for x in np.meshgrid(*parts, indexing="ij")]


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
    """`function(*point, scene)` on a grid: results as NumPy arrays, and how many points a store had already.

    With many processes each takes its turn of the blocks; every process returns all.
    """
    run = Runner(function, plan.axes, scene, math.prod(plan.block))
    own, count = process()
    done = store.finished() if store else np.zeros(math.prod(plan.blocks), bool)
    if store:
        meet()  # all have seen the same blocks before one of them writes more
    left = np.flatnonzero(~done).tolist()
    mine = left[own::count]
    resumed = int(plan.sizes[done].sum())
    if resumed and own == 0 and progress is not False:
        print(f"{label}: {resumed:,} of {math.prod(plan.shape):,} points come from {store.path}", file=sys.stderr)
    bar = Progress(int(plan.sizes[mine].sum()), label, progress if own == 0 else False)
    whole = not store and mine == [0] and plan.block == plan.shape  # nothing to put together
    results = None if store or whole else [np.empty((*plan.shape, *x.shape), x.dtype) for x in run.shapes]

    for number in mine:
        place = plan.place(number)
        shape = tuple(p.stop - p.start for p in place)
        found = run(plan.points(number), bar.add, _tiles(shape, columns))
        found = [leaf.reshape(*shape, *leaf.shape[1:]) for leaf in found]
        if store:
            store.write(place, found)
        elif whole:
            results = found
        else:
            for leaf, part in zip(results, found):
                leaf[place] = part
    if count > 1:
        meet()
        if not store:
            _gather(results, plan, left)
    if store:
        results = store.read() if load else None
    return None if results is None else jax.tree.unflatten(run.tree, results), resumed


def _gather(results: list[np.ndarray], plan: Plan, numbers: list[int]) -> None:
    """Give every process the blocks of all, a round of one block each at a time."""
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


def layout(points: int, devices: int, platform: str) -> tuple[int, int, int]:
    """Shape of a batch: rows, devices, lanes. As many lanes at once as there are points, in few different numbers,
    each of which is compiled."""
    share = -(-points // devices)
    least, most = (64, 16384) if platform == "cpu" else (1024, 65536)
    lanes = 2 ** (min(max(share, least), most) - 1).bit_length()
    rows = min(_ROWS, 2 ** (max(-(-share // lanes), 1) - 1).bit_length())
    return rows, devices, lanes


def _deal(points: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Flat points in the shape of a batch. Chunks are dealt in turn: neighbours cost alike, so shares do, too."""
    rows, devices, lanes = shape
    return points.reshape(rows, lanes // _CHUNK, devices, _CHUNK).swapaxes(1, 2).reshape(shape)


@functools.lru_cache(maxsize=16)
def _dealt(shape: tuple[int, int, int]) -> list[np.ndarray]:
    """Which of a batch's points every device has, in its order."""
    return [own.ravel() for own in np.moveaxis(_deal(np.arange(math.prod(shape)), shape), 1, 0)]


@functools.lru_cache(maxsize=16)
def _tiles(shape: tuple[int, ...], columns: bool) -> np.ndarray:
    """The order of a block's flat points in which neighbours along both of its last axes are near each other, those
    along the last (`columns`: the last but one) nearest."""
    if len(shape) < 2:
        return np.arange(math.prod(shape))
    *rest, i, j = (x.ravel() for x in np.indices(shape))
    within = (i, j) if columns else (j, i)
    return np.lexsort((*within, j // _TILE, i // _TILE, *reversed(rest)))


class Runner:
    """One compiled function of a batch of points; call it with any number of flat points."""

    def __init__(self, function: Callable, axes: tuple[np.ndarray, ...], scene, points: int):
        devices = local_devices()
        self._layout = layout(points, len(devices), devices[0].platform)
        mesh = Mesh(np.array(devices), ("devices",))
        self._dealt = NamedSharding(mesh, PartitionSpec(None, "devices"))
        self._scene = jax.device_put(scene, NamedSharding(mesh, PartitionSpec()))
        self._call, self._messages = _compiled(function, mesh)
        like = [jax.ShapeDtypeStruct(self._layout, values.dtype, sharding=self._dealt) for values in axes]
        found, _ = self._call.eval_shape(like, np.int32(0), self._scene)
        found, self.tree = jax.tree.flatten(found)
        self.shapes = [jax.ShapeDtypeStruct(x.shape[3:], x.dtype) for x in found]

    def __call__(
        self,
        points: list[np.ndarray],
        report: Callable[[int], None] = lambda more: None,
        order: np.ndarray | None = None,
    ) -> list[np.ndarray]:
        """Results at flat points: the leaves of what the function returns, as NumPy arrays; `order`: in which they are
        computed."""
        order = np.arange(points[0].size) if order is None else order
        found = [np.empty((order.size, *x.shape), x.dtype) for x in self.shapes]
        for numbers, leaves in self._batches(points, order):
            for device, dealt in enumerate(_dealt(self._layout)):
                there = dealt < numbers.size
                targets = numbers[dealt] if there.all() else numbers[dealt[there]]
                own = [self._of_device(part, device) for part in leaves]
                own = own if there.all() else [x[there] for x in own]
                for message, failed in zip(self._messages, own[len(found) :]):
                    if failed.any():
                        place = ", ".join(f"{x[targets[failed.argmax()]]:g}" for x in points)
                        raise ValueError(f"{message}, but is not at the point ({place}).")
                for whole, part in zip(found, own):
                    whole[targets] = part
            report(numbers.size)
        return found

    @staticmethod
    def _of_device(dealt: jax.Array, device: int) -> np.ndarray:
        """One device's part of results: its own memory, where that can be read."""
        (shard,) = (x for x in dealt.addressable_shards if (x.index[1].start or 0) == device)
        part = np.asarray(shard.data)
        return part.reshape(-1, *part.shape[3:])

    def _batches(self, points: list[np.ndarray], order: np.ndarray) -> Iterator[tuple[np.ndarray, list[jax.Array]]]:
        """Numbers of points, and their results. One batch is under way while the one before it is taken."""
        waiting, batch = collections.deque(), math.prod(self._layout)
        for begin in range(0, order.size, batch):
            numbers = order[begin : begin + batch]
            rows = np.int32(-(-numbers.size // math.prod(self._layout[1:])))
            parts = [np.pad(x[numbers], (0, batch - numbers.size), mode="edge") for x in points]
            found = self._call(jax.device_put([_deal(x, self._layout) for x in parts], self._dealt), rows, self._scene)
            waiting.append((numbers, jax.tree.leaves(found)))
            if len(waiting) > 1:
                yield waiting.popleft()
        yield from waiting


@functools.lru_cache(maxsize=32)
def _compiled(function: Callable, mesh: Mesh) -> tuple[Callable, list[str]]:
    """`function(*point, scene)` over the first so many rows of points of shape (rows, devices, lanes).

    It returns the results, and for each of the messages (known once it is traced) whether it applies.
    """
    messages = []

    def on_one(points, rows, scene):
        own = [x[:, 0] for x in points]  # this device's

        def one(*point):
            if isinstance(function, Traced):
                messages[:] = function.messages
                return function(*point, scene)
            with put_down() as checks:
                found = function(*point, scene)
            messages[:] = [message for message, _ in checks]
            return found, tuple(failed for _, failed in checks)

        def row(number):
            return jax.vmap(one)(*(x[number] for x in own))

        def put(number, found):
            return jax.tree.map(lambda whole, part: whole.at[number, 0].set(part), found, row(number))

        # The number of rows is an argument, so that grids of any number of rows take the same compiled program.
        empty = jax.tree.map(lambda x: jnp.zeros((own[0].shape[0], 1, *x.shape), x.dtype), jax.eval_shape(row, 0))
        return jax.lax.fori_loop(0, rows, put, empty)

    dealt = PartitionSpec(None, "devices")
    spread = jax.shard_map(
        on_one, mesh=mesh, in_specs=(dealt, PartitionSpec(), PartitionSpec()), out_specs=dealt, check_vma=False
    )
    return jax.jit(spread, compiler_options=compiler_options(mesh.devices.flat[0].platform)), messages
