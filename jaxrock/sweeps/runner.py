"""One compiled function of a batch of points, dealt to the devices."""

import collections
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxrock._checks import put_down
from jaxrock.sweeps.devices import compiler_options, local_devices
from jaxrock.sweeps.plan import deal, dealt_to, layout
from jaxrock.transforms.fingerprint import Program


class Runner:
    """One compiled function of a batch of points; call it with any number of flat points."""

    def __init__(self, function: Callable, axes: tuple[np.ndarray, ...], scene, points: int):
        devices = local_devices()
        self._layout = layout(points, len(devices), devices[0].platform)
        mesh = Mesh(np.array(devices), ("devices",))
        self._dealt = NamedSharding(mesh, PartitionSpec(None, "devices"))
        self._scene = jax.device_put(scene, NamedSharding(mesh, PartitionSpec()))
        self._call = _compiled(function, mesh)
        like = [jax.ShapeDtypeStruct(self._layout, values.dtype, sharding=self._dealt) for values in axes]
        checked = self._call.eval_shape(like, np.int32(0), self._scene)
        self._messages = checked.messages
        results, self.tree = jax.tree.flatten(checked.results)
        self.shapes = [jax.ShapeDtypeStruct(x.shape[3:], x.dtype) for x in results]

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
                there = dealt < numbers.size
                targets = numbers[dealt] if there.all() else numbers[dealt[there]]
                own = [self._of_device(part, device) for part in leaves]
                own = own if there.all() else [x[there] for x in own]
                for message, failed in zip(self._messages, own[len(results) :]):
                    if failed.any():
                        place = ", ".join(f"{x[targets[failed.argmax()]]:g}" for x in points)
                        raise ValueError(f"{message}, but is not at the point ({place}).")
                for whole, part in zip(results, own):
                    whole[targets] = part
            report(numbers.size)
        return results

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
            results = self._call(jax.device_put([deal(x, self._layout) for x in parts], self._dealt), rows, self._scene)
            waiting.append((numbers, jax.tree.leaves(results)))
            if len(waiting) > 1:
                yield waiting.popleft()
        yield from waiting


class _Checked(eqx.Module):
    """Results, and for each of the messages whether it applies."""

    results: Any
    failed: tuple
    messages: tuple[str, ...] = eqx.field(static=True)


# A function is a `Program`, known by its text, or one of the package, of which there is one: what a user gives lies in
# the scene, a pytree, by whose structure `jax.jit` tells programs apart.
@functools.lru_cache(maxsize=32)
def _compiled(function: Callable, mesh: Mesh) -> Any:
    """`function(*point, scene)` over the first so many rows of points of shape (rows, devices, lanes), `_Checked`."""

    def on_one(points, rows, scene):
        own = [x[:, 0] for x in points]  # this device's

        def one(*point):
            if isinstance(function, Program):
                return _Checked(*function(*point, scene), function.messages)
            with put_down() as checks:
                results = function(*point, scene)
            return _Checked(results, tuple(failed for _, failed in checks), tuple(message for message, _ in checks))

        def row(number):
            return jax.vmap(one)(*(x[number] for x in own))

        def put(number, whole):
            return jax.tree.map(lambda whole, part: whole.at[number, 0].set(part), whole, row(number))

        # The number of rows is an argument, so that grids of any number of rows take the same compiled program.
        empty = jax.tree.map(lambda x: jnp.zeros((own[0].shape[0], 1, *x.shape), x.dtype), jax.eval_shape(row, 0))
        return jax.lax.fori_loop(0, rows, put, empty)

    dealt = PartitionSpec(None, "devices")
    spread = jax.shard_map(
        on_one, mesh=mesh, in_specs=(dealt, PartitionSpec(), PartitionSpec()), out_specs=dealt, check_vma=False
    )
    return jax.jit(spread, compiler_options=compiler_options(mesh.devices.flat[0].platform))
