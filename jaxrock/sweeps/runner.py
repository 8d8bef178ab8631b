"""Compiled function of a batch of points, dealt to the devices."""

import collections
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxrock.compiler import checks
from jaxrock.compiler.hints import LOW_EFFORT_LIMIT, low_effort_options
from jaxrock.sweeps.devices import compiler_options, local_devices
from jaxrock.sweeps.plan import dealt_to, layout, shard

_EVERYWHERE, _DEALT = PartitionSpec(), PartitionSpec("devices")
# A function marked `cheap_per_point` is compiled briefly for at most `_FEW` points, and at most `_LITTLE` points times
# numbers of its scene: these take less time than a thorough compilation (`benchmarks/fits.md`).
_FEW, _LITTLE = 2**14, 2_000_000
_CHEAP = "_follows_one_rigid_block"


def cheap_per_point(function: Callable) -> Callable:
    """Mark a function of a point that follows one rigid block.

    Where it gets no machine code of its own, XLA compiles it for as long as thousands of points take.
    """
    setattr(function, _CHEAP, True)
    return function


class Runner:
    """Compiled function of a batch of points; call it with any number of flat points.

    `points`: the most points of one call; `in_all`: the most points of all calls (None: `points`).
    """

    def __init__(self, function: Callable, axes: tuple[np.ndarray, ...], scene, points: int, in_all: int | None = None):
        devices = local_devices()
        self._layout = layout(points, len(devices), devices[0].platform)
        self._mesh = _mesh_of(tuple(devices))
        flat: tuple[list, Any] = jax.tree.flatten(self._at_hand(scene))
        leaves, structure = flat
        self._scene = structure.unflatten(leaves)
        kinds, like = tuple(x.dtype for x in axes), tuple(map(jax.typeof, leaves))
        in_all = in_all or points
        brief = hasattr(function, _CHEAP) and in_all <= _FEW and in_all * sum(x.size for x in like) <= _LITTLE
        self._call, self._messages, self.tree, self.shapes = _compiled(
            function, self._mesh, self._layout, kinds, structure, like, in_all <= LOW_EFFORT_LIMIT, brief
        )

    def __call__(
        self,
        points: list[np.ndarray],
        report: Callable[[int], None] = lambda more: None,
        order: np.ndarray | None = None,
    ) -> list[np.ndarray]:
        """Return results at flat points: the leaves of the function's result, as NumPy arrays.

        `order`: the order in which points are computed.
        """
        order = np.arange(points[0].size) if order is None else order
        results = [np.empty((order.size, *x.shape), x.dtype) for x in self.shapes]
        for numbers, leaves in self._batches(points, order):
            for device, dealt in enumerate(dealt_to(self._layout)):
                own = [self._of_device(part, device) for part in leaves]
                if dealt[-1] < numbers.size:  # this share is complete
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
        """Put arrays on the devices of the computation; arrays that already are on the only device stay."""
        devices = self._mesh.devices.ravel()
        if devices.size > 1:
            return jax.device_put(tree, NamedSharding(self._mesh, _EVERYWHERE))

        def put(x):
            return x if isinstance(x, jax.Array) and x.device == devices[0] else jax.device_put(x, devices[0])

        return jax.tree.map(put, tree)

    def _of_device(self, dealt: jax.Array, device: int) -> np.ndarray:
        """Return one device's part of the results, without a copy where its memory can be read."""
        if self._mesh.size == 1:
            return np.asarray(dealt)
        begin = device * self._layout[1]
        if dealt.size == 0:  # JAX cannot shard an empty array
            return np.asarray(dealt)[begin : begin + self._layout[1]]
        (shard,) = (x for x in dealt.addressable_shards if (x.index[0].start or 0) == begin)
        return np.asarray(shard.data)

    def _batches(self, points: list[np.ndarray], order: np.ndarray) -> Iterator[tuple[np.ndarray, list[jax.Array]]]:
        """Yield numbers of points and their results; one batch is under way while the one before it is read."""
        waiting, batch = collections.deque(), math.prod(self._layout)
        for begin in range(0, order.size, batch):
            numbers = order[begin : begin + batch]
            parts = [x[numbers] for x in points]
            if numbers.size < batch:
                parts = [np.concatenate([x, np.repeat(x[-1:], batch - numbers.size)]) for x in parts]
            dealt = [shard(x, self._layout) for x in parts]
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


# `function` is one of the package, which exists once. User input lies in the scene, a pytree: a user's function is one,
# too, and its jaxpr is a part of the structure by which `jax.jit` tells programs apart.
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
    """Compile `function(*point, scene)` for batches of points of these types; also return its result shapes."""
    at_first = few and mesh.size == 1
    call = _call_of(function, mesh, at_first)
    like = [jax.ShapeDtypeStruct((math.prod(shape),), kind) for kind in kinds]
    told = jax.eval_shape(call, like, structure.unflatten(scene))
    results, tree = jax.tree.flatten(told.results)
    shapes = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in results]
    return _Compiled(_AtFirst(call, mesh, brief) if at_first else call, told.messages, tree, shapes)


class _AtFirst:
    """Function of a batch of few points on one device; its first batch chooses the compiler options.

    `brief`: compile in the least time, even if the function has loops.
    """

    def __init__(self, function: Any, mesh: Mesh, brief: bool):
        self._function, self._brief, self._compiled = function, brief, None
        self._platform = mesh.devices.flat[0].platform

    def __call__(self, *batch):
        if self._compiled is None:
            lowered = self._function.lower(*batch)
            # Without loops, scenes are machine code of their own, and the program around them is compiled quickly.
            quick = self._platform == "cpu" and (self._brief or "stablehlo.while" not in lowered.as_text())
            self._compiled = lowered.compile(low_effort_options() if quick else compiler_options(self._platform))
        return self._compiled(*batch)


@functools.lru_cache(maxsize=32)
def _call_of(function: Callable, mesh: Mesh, at_first: bool) -> Callable:
    """Return `function(*point, scene)` over points dealt to devices, with their checks.

    XLA's options are set here, or at compilation if `at_first`.
    """

    def on_one(points, scene):
        return jax.vmap(lambda *point: checks.with_checks(function)(*point, scene))(*points)

    options = None if at_first else compiler_options(mesh.devices.flat[0].platform)
    if mesh.size == 1:
        return jax.jit(on_one, compiler_options=options)
    spread = jax.shard_map(on_one, mesh=mesh, in_specs=(_DEALT, _EVERYWHERE), out_specs=_DEALT, check_vma=False)
    return jax.jit(spread, compiler_options=options)
