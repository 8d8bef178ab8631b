"""Implement JAX's operations in NumPy, to move elements of small arrays and to fold constants."""

from collections.abc import Callable

import numpy as np

from jaxrock.compiler.llvm.operations import Unsupported


def _broadcast(parameters, x):
    shape = parameters["shape"]
    places = dict(zip(parameters["broadcast_dimensions"], x.shape))
    return np.broadcast_to(x.reshape([places.get(axis, 1) for axis in range(len(shape))]), shape)


def _slice(parameters, x):
    ends = parameters["start_indices"], parameters["limit_indices"], parameters["strides"] or [1] * x.ndim
    return x[tuple(slice(*each) for each in zip(*ends))]


def _pad(parameters, x, filling):
    config = parameters["padding_config"]
    if any(min(each) < 0 for each in config):
        raise Unsupported("padding that takes away")
    inner = [n + max(n - 1, 0) * between for n, (_, _, between) in zip(x.shape, config)]
    padded = np.full([low + n + high for n, (low, high, _) in zip(inner, config)], filling[()], object)
    places = zip(inner, config)
    padded[tuple(slice(low, low + n, between + 1) for n, (low, _, between) in places)] = x
    return padded


# Operations that only move elements: functions of the parameters and of NumPy arrays, whose elements may be vectors of
# LLVM.
MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "squeeze": lambda parameters, x: np.squeeze(x, parameters["dimensions"]),
    "reshape": lambda parameters, x: x.reshape(parameters["new_sizes"]),
    "transpose": lambda parameters, x: x.transpose(parameters["permutation"]),
    "rev": lambda parameters, x: np.flip(x, parameters["dimensions"]),
    "pad": _pad,
    "split": lambda parameters, x: np.split(x, np.cumsum(parameters["sizes"])[:-1], parameters["axis"]),
    "concatenate": lambda parameters, *xs: np.concatenate(xs, parameters["dimension"]),
    "unstack": lambda parameters, x: [
        part.squeeze(parameters["axis"]) for part in np.split(x, x.shape[parameters["axis"]], parameters["axis"])
    ],
    "stack": lambda parameters, *xs: np.stack(xs, parameters["axis"]),
}


def _convert_known(parameters, x):
    if x.dtype.kind == "f" and np.dtype(parameters["new_dtype"]).kind != "f":
        return None  # out of range JAX saturates, and NumPy does not
    return x.astype(parameters["new_dtype"])


def _iota(dtype, shape, dimension, **_):
    places = np.arange(shape[dimension], dtype=dtype)
    return np.broadcast_to(places.reshape([-1 if axis == dimension else 1 for axis in range(len(shape))]), shape)


def _taken(parameters, x, *starts):
    sizes = parameters["slice_sizes"]
    starts = [min(max(int(start), 0), n - size) for start, n, size in zip(starts, x.shape, sizes)]
    return x[tuple(slice(start, start + size) for start, size in zip(starts, sizes))]


# Operations on constants: functions of the parameters and NumPy arrays. Only those that NumPy rounds as XLA does.
KNOWN: dict[str, Callable] = {
    **{name: MOVES[name] for name in MOVES if name != "pad"},
    **{
        name: (lambda _, *xs, f=f: f(*xs))
        for name, f in {
            "add": np.add,
            "sub": np.subtract,
            "mul": np.multiply,
            "neg": np.negative,
            "abs": np.abs,
            "min": np.minimum,
            "max": np.maximum,
            "eq": np.equal,
            "ne": np.not_equal,
            "lt": np.less,
            "le": np.less_equal,
            "gt": np.greater,
            "ge": np.greater_equal,
            "and": np.bitwise_and,
            "or": np.bitwise_or,
            "not": np.invert,
            "is_finite": np.isfinite,
        }.items()
    },
    "reduce_or": lambda parameters, x: np.bitwise_or.reduce(x, parameters["axes"]),
    "reduce_and": lambda parameters, x: np.bitwise_and.reduce(x, parameters["axes"]),
    "reduce_max": lambda parameters, x: np.max(x, parameters["axes"]),
    "iota": lambda parameters: _iota(**parameters),
    "dynamic_slice": _taken,
    "convert_element_type": _convert_known,
    "select_n": lambda _, which, *cases: np.choose(which.astype(int), cases),
}
