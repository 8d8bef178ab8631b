"""Operations that consist of many: single ones in the programs of JAX, written out where these are compiled.

A polynomial of degree 16 is one operation to trace, to batch and to differentiate, and not 32; its derivative is one
more, and not three times as many. XLA, and machine code of our own, get what it is `written` as.
"""

import functools
from collections.abc import Callable, Hashable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from jaxrock._abstract import typed_like, without_mesh
from jaxrock._precision import setting
from jaxrock._settings import under_usual_settings, usual_settings
from jaxrock.numerics.typed import common_type, typed
from jaxrock.numerics.xla_cpu import marking

Zero = ad.Zero
_OPERATIONS: dict[str, "Compound"] = {}  # by the names of their primitives: set at import only


class Compound:
    """A function `function(*numbers, **settings)` that returns a list of numbers, as a single operation of JAX.

    - `name`: of that operation, of which there is one (behind `compound_`).
    - `function`: of arrays that fit each other's shapes, in operations that work on each of their numbers; settings are
      hashable.
    - `change`: of the operation, numbers, their changes (`Zero` where there is none) and the settings: results and
      their changes. None: those of what it consists of.
    - `results`: how many there are, or a function of the number of numbers and of the settings that tells.
    """

    def __init__(self, name: str, function: Callable, change: Callable | None = None, results: int | Callable = 1):
        self._function, self.change, self._results = function, change, results
        # JAX 0.12 has a `polynomial` of its own: in programs they are told by their names.
        name = f"compound_{name}"
        self.primitive = primitive = Primitive(name)
        primitive.multiple_results = True
        primitive.def_impl(self._alone)
        primitive.def_abstract_eval(self._types)
        batching.primitive_batchers[primitive] = functools.partial(_batched, primitive)
        ad.primitive_jvps[primitive] = self._pushed
        ad.primitive_transposes[primitive] = self._transposed
        mlir.register_lowering(primitive, functools.partial(_lowered, name))
        _OPERATIONS[name] = self

    def __call__(self, *numbers, **settings) -> list:
        dtype = common_type(*numbers)
        return self.primitive.bind(*(typed(x, dtype) for x in numbers), **settings)

    def written(self, *numbers, **settings) -> list:
        """The results, in the operations that it consists of."""
        shape = jnp.broadcast_shapes(*map(jnp.shape, numbers))
        return [jnp.broadcast_to(x, shape) for x in self._function(*numbers, **settings)]

    def _types(self, *operands, **settings) -> list:
        shape = jnp.broadcast_shapes(*(x.shape for x in operands))
        count = self._results(len(operands), **settings) if callable(self._results) else self._results
        return typed_like(operands, [(shape, operands[0].dtype)] * count)

    def _alone(self, *numbers, **settings) -> list:
        with usual_settings():
            return _compiled(self.primitive, tuple(settings.items()))(*numbers)

    def _of_some(self, numbers, chosen: list[bool], settings: dict) -> Callable:
        """The function of some of the numbers."""

        def of(*own):
            rest = iter(own)
            return self.written(*(next(rest) if mine else x for x, mine in zip(numbers, chosen)), **settings)

        return of

    @under_usual_settings
    def _pushed(self, numbers, changes, **settings):
        if self.change is not None:
            return self.change(self, numbers, changes, **settings)
        moves = [type(d) is not Zero for d in changes]
        moving, moved = ([x for x, move in zip(each, moves) if move] for each in (numbers, changes))
        return jax.jvp(self._of_some(numbers, moves, settings), moving, moved)

    @under_usual_settings
    def _transposed(self, cotangents, *numbers, **settings):
        linear = [ad.is_undefined_primal(x) for x in numbers]
        like = [x.aval for x, is_linear in zip(numbers, linear) if is_linear]
        given = [ad.instantiate_zeros(d) for d in cotangents]
        found = iter(jax.linear_transpose(self._of_some(numbers, linear, settings), *like)(given))
        return [next(found) if is_linear else None for is_linear in linear]


@functools.lru_cache(maxsize=256)
def _compiled(primitive: Primitive, settings: tuple) -> Callable:
    return jax.jit(functools.partial(primitive.bind, **dict(settings)))


def is_compound(name: str) -> bool:
    """Return whether a primitive of this name consists of others."""
    return name in _OPERATIONS


def changed(name: str, numbers: list, changes: list, settings: dict, through: Callable) -> tuple[list, list]:
    """The results of an operation, and their changes, of single numbers whose changes (None: there is none) may have
    one more axis; `through(program, numbers, changes)` goes through what has no rule of its own."""
    operation = _OPERATIONS[name]
    if operation.change is None:
        return through(written(name, numbers, settings), numbers, changes)
    told = [Zero(jax.typeof(x).to_tangent_aval()) if d is None else d for x, d in zip(numbers, changes)]
    values, found = operation.change(operation, numbers, told, **settings)
    return values, [None if type(d) is Zero else d for d in found]


def of_all(change, value):
    """A change as large as its value, or with one more axis than that."""
    return jnp.broadcast_to(change, jnp.broadcast_shapes(jnp.shape(change), value.shape))


def written(name: str, operands: list, settings: dict) -> ClosedJaxpr:
    """What an operation consists of, for such operands, as a program."""
    return _program(name, *_kept_by(operands, settings))


def _kept_by(operands: Sequence, settings: dict) -> tuple[tuple, tuple, bool]:
    """What tells a program of an operation: kinds of operands, settings, and the precision, which integers follow."""
    return tuple((x.shape, x.dtype) for x in operands), tuple(settings.items()), setting("jax_enable_x64")


@functools.lru_cache(maxsize=4096)
@under_usual_settings
def _program(name: str, kinds: tuple, settings: tuple[tuple[str, Hashable], ...], double: bool) -> ClosedJaxpr:
    like = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
    # It is kept: outside of any mesh, and for any compiler.
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())), marking(True):
        return jax.make_jaxpr(functools.partial(_OPERATIONS[name].written, **dict(settings)))(*like)


@functools.lru_cache(maxsize=4096)
def _called(name: str, kinds: tuple, settings: tuple, double: bool) -> Callable:
    """The same as a function of its own, which is lowered once in a module."""
    return jax.jit(jaxpr_as_fun(_program(name, kinds, settings, double)))


@under_usual_settings
def _lowered(name: str, context, *operands, **settings):
    return mlir.lower_fun(_called(name, *_kept_by(context.avals_in, settings)))(without_mesh(context), *operands)


@under_usual_settings
def _batched(primitive: Primitive, operands, axes, **settings) -> tuple[list, list]:
    """Numbers fit each other's shapes, so what is not mapped needs no axis."""
    most = max(jnp.ndim(x) - (axis is not None) for x, axis in zip(operands, axes))

    def moved(x, axis):
        if axis is None:
            return x
        x = jnp.moveaxis(x, axis, 0)
        return x.reshape(x.shape[0], *[1] * (most + 1 - x.ndim), *x.shape[1:])

    found = primitive.bind(*map(moved, operands, axes), **settings)
    return found, [0] * len(found)
