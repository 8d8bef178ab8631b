"""One compiled function of a batch of points, dealt to the devices."""

import collections
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxrock._quickly import MUCH, options as quick_options
from jaxrock.sweeps.devices import compiler_options, local_devices
from jaxrock.sweeps.plan import deal, dealt_to, layout
from jaxrock.transforms.fingerprint import Checked, Program, with_checks

_EVERYWHERE, _DEALT = PartitionSpec(), PartitionSpec("devices")
# Points of light functions, and these times numbers of their scene, that take less time than to compile them well
# (`benchmarks/fits.md`).
_FEW, _LITTLE = 2**14, 2_000_000
_LIGHT = "_follows_one_rigid_block"


def light(function: Callable) -> Callable:
    """Decorate a function of a point that follows one rigid block: where no machine code is made of it, XLA compiles it
    for as long as thousands of points take."""
    setattr(function, _LIGHT, True)
    return function


class Runner:
    """One compiled function of a batch of points; call it with any number of flat points: so many at once, at most,
    and so many in all (None: no more)."""

    def __init__(self, function: Callable, axes: tuple[np.ndarray, ...], scene, points: int, in_all: int | None = None):
        devices = local_devices()
        self._layout = layout(points, len(devices), devices[0].platform)
        self._mesh = _mesh_of(tuple(devices))
        flat: tuple[list, Any] = jax.tree.flatten(self._at_hand(scene))
        leaves, structure = flat
        self._scene = structure.unflatten(leaves)
        kinds, like = tuple(x.dtype for x in axes), tuple(map(jax.typeof, leaves))
        in_all = in_all or points
        brief = hasattr(function, _LIGHT) and in_all <= _FEW and in_all * sum(x.size for x in like) <= _LITTLE
        self._call, self._messages, self.tree, self.shapes = _compiled(
            function, self._mesh, self._layout, kinds, structure, like, in_all <= MUCH, brief
        )

    def __call__(
        self,
        points: list[np.ndarray],
        report: Callable[[int], None] = lambda more: None,
        order: np.ndarray | None = None,
    ) -> list[np.ndarray]:
        """Results at flat points: the leaves of what the function returns, as NumPy arrays; `order`: in which they are
        computed."""
        order = np.arange(points[0].size) if order is None else order
        results = [np.empty((order.size, *x.shape), x.dtype) for x in self.shapes]
        for numbers, leaves in self._batches(points, order):
            for device, dealt in enumerate(dealt_to(self._layout)):
                own = [self._of_device(part, device) for part in leaves]
                if dealt[-1] < numbers.size:  # its share of a batch that is full
                    targets = numbers[dealt]
                else:
                    there = dealt < numbers.size
                    targets, own = numbers[dealt[there]], [x[there] for x in own]
                for message, failed in zip(self._messages, own[len(results) :]):
                    if failed.any():
                        place = ", ".join(f"{x[targets[failed.argmax()]]:g}" for x in points)
                        raise ValueError(f"{message}, but is not at the point ({place}).")
                for whole, part in zip(results, own):
                    whole[targets] = part
            report(numbers.size)
        return results

    def _at_hand(self, tree):
        """Arrays where the function is computed; what is on its only device already goes as it is."""
        devices = self._mesh.devices.ravel()
        if devices.size > 1:
            return jax.device_put(tree, NamedSharding(self._mesh, _EVERYWHERE))

        def put(x):
            return x if isinstance(x, jax.Array) and x.device == devices[0] else jax.device_put(x, devices[0])

        return jax.tree.map(put, tree)

    def _of_device(self, dealt: jax.Array, device: int) -> np.ndarray:
        """One device's part of results: its own memory, where that can be read."""
        if self._mesh.size == 1:
            return np.asarray(dealt)
        begin = device * self._layout[1]
        if dealt.size == 0:  # JAX cannot shard an empty array
            return np.asarray(dealt)[begin : begin + self._layout[1]]
        (shard,) = (x for x in dealt.addressable_shards if (x.index[0].start or 0) == begin)
        return np.asarray(shard.data)

    def _batches(self, points: list[np.ndarray], order: np.ndarray) -> Iterator[tuple[np.ndarray, list[jax.Array]]]:
        """Numbers of points, and their results. One batch is under way while the one before it is taken."""
        waiting, batch = collections.deque(), math.prod(self._layout)
        for begin in range(0, order.size, batch):
            numbers = order[begin : begin + batch]
            parts = [x[numbers] for x in points]
            if numbers.size < batch:
                parts = [np.concatenate([x, np.repeat(x[-1:], batch - numbers.size)]) for x in parts]
            dealt = [deal(x, self._layout) for x in parts]
            if self._mesh.size > 1:
                dealt = jax.device_put(dealt, NamedSharding(self._mesh, _DEALT))
            results = self._call(dealt, self._scene)
            waiting.append((numbers, jax.tree.leaves(results)))
            if len(waiting) > 1:
                yield waiting.popleft()
        yield from waiting


@functools.lru_cache(maxsize=4)
def _mesh_of(devices: tuple) -> Mesh:
    return Mesh(np.array(devices), ("devices",))


class _Compiled(NamedTuple):
    """A function of points and a scene, its messages, and the structure, shapes and types of its results at a point."""

    call: Callable
    messages: tuple[str, ...]
    tree: Any
    shapes: list[jax.ShapeDtypeStruct]


# A function is a `Program`, known by its text, or one of the package, of which there is one: what a user gives lies in
# the scene, a pytree, by whose structure `jax.jit` tells programs apart.
@functools.lru_cache(maxsize=64)
def _compiled(
    function: Callable,
    mesh: Mesh,
    shape: tuple[int, int],
    kinds: tuple,
    structure,
    scene: tuple,
    few: bool,
    brief: bool,
) -> _Compiled:
    """`function(*point, scene)` at a batch of points of these kinds of numbers, and what is known of it beforehand."""
    at_first = few and mesh.size == 1
    call = _call_of(function, mesh, at_first)
    like = [jax.ShapeDtypeStruct((math.prod(shape),), kind) for kind in kinds]
    told = jax.eval_shape(call, like, structure.unflatten(scene))
    results, tree = jax.tree.flatten(told.results)
    shapes = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in results]
    return _Compiled(_AtFirst(call, mesh, brief) if at_first else call, told.messages, tree, shapes)


class _AtFirst:
    """A function of a batch of few points on one device, compiled for its first batch as what is in it wants it;
    `brief`: in the least time, also if it has loops."""

    def __init__(self, function: Any, mesh: Mesh, brief: bool):
        self._function, self._brief, self._compiled = function, brief, None
        self._platform = mesh.devices.flat[0].platform

    def __call__(self, *batch):
        if self._compiled is None:
            lowered = self._function.lower(*batch)
            # Where no loop is left, scenes are machine code of their own, and what is around them takes a moment.
            quick = self._platform == "cpu" and (self._brief or "stablehlo.while" not in lowered.as_text())
            self._compiled = lowered.compile(quick_options() if quick else compiler_options(self._platform))
        return self._compiled(*batch)


@functools.lru_cache(maxsize=32)
def _call_of(function: Callable, mesh: Mesh, at_first: bool) -> Callable:
    """`function(*point, scene)` over points that are dealt to devices, `_Checked`; XLA's options are told now, or where
    it is compiled `at_first`."""

    def on_one(points, scene):
        def one(*point):
            if isinstance(function, Program):
                return Checked(*function(*point, scene), function.messages)
            return with_checks(function)(*point, scene)

        return jax.vmap(one)(*points)

    options = None if at_first else compiler_options(mesh.devices.flat[0].platform)
    if mesh.size == 1:
        return jax.jit(on_one, compiler_options=options)
    spread = jax.shard_map(on_one, mesh=mesh, in_specs=(_DEALT, _EVERYWHERE), out_specs=_DEALT, check_vma=False)
    return jax.jit(spread, compiler_options=options)
