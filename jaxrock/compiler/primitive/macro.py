"""Macro primitives: one operation in a jaxpr, which is expanded into many where the jaxpr is compiled.

A polynomial of degree 16 is one operation to trace, to batch and to differentiate, instead of 32. Its derivative is one
more, instead of three times as many. XLA and `llvm` compile the expansion.
"""

import functools
from collections.abc import Callable, Hashable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from jaxrock._core.precision import setting
from jaxrock._core.settings import under_usual_settings, usual_settings
from jaxrock.compiler.hints.as_dtype import as_dtype, common_type
from jaxrock.compiler.hints.materialize import with_hints
from jaxrock.compiler.ordinary import IS_ORDINARY
from jaxrock.compiler.primitive.sharding_types import typed_like, without_mesh

Zero = ad.Zero
IMPLEMENTATIONS: dict[str, Callable] = {}  # by the names of JAX's primitives; set at import only
_OPERATIONS: dict[str, "MacroPrimitive"] = {}  # by the names of their primitives; set at import only


class MacroPrimitive:
    """An elementwise function of arrays that is a single primitive of JAX; it returns a list.

    **Arguments:**

    - `name`: unique name of the primitive, without the prefix `macro_`.
    - `function`: `function(*arrays, **settings)`, elementwise on arrays that broadcast; returns a list. Settings are
      hashable.
    - `change`: rule of forward mode, `change(primitive, arrays, tangents, **settings)`; returns the results and their
      tangents. In both lists of tangents, None stands for zero. Without a rule, the expansion is differentiated.
    - `results`: number of results, or a function of the number of arrays and of the settings that returns it.

    **Returns:** a callable, `primitive(*arrays, **settings)`.

    **Example:**

    ```python
    import jax, jax.numpy as jnp
    from jaxrock.compiler import MacroPrimitive

    def _changed(cube, arrays, tangents):
        (x,), (dx,) = arrays, tangents
        return cube(x), [None if dx is None else 3 * x * x * dx]

    cube = MacroPrimitive("cube", lambda x: [x * x * x], _changed)
    values = cube(jnp.array([2.0, 3.0]))[0]
    slope = jax.grad(lambda x: cube(x)[0])(2.0)
    ```
    """

    def __init__(self, name: str, function: Callable, change: Callable | None = None, results: int | Callable = 1):
        self._function, self.change, self._results = function, change, results
        # The prefix keeps names apart in jaxprs: JAX 0.12 has a `polynomial` of its own.
        name = f"macro_{name}"
        self.primitive = primitive = Primitive(name)
        primitive.multiple_results = True
        primitive.def_impl(self._alone)
        primitive.def_abstract_eval(self._types)
        batching.primitive_batchers[primitive] = functools.partial(_batched, primitive)
        ad.primitive_jvps[primitive] = self._pushed
        ad.primitive_transposes[primitive] = self._transposed
        mlir.register_lowering(primitive, functools.partial(_lowered, name))
        _OPERATIONS[name] = self

    @staticmethod
    def implement(name: str, function: Callable) -> None:
        """Let machine code compute a primitive of JAX by other operations, as a call of the C library is slow.

        **Arguments:**

        - `name`: name of JAX's primitive.
        - `function`: an equal function of arrays, in operations that machine code knows.
        """
        IMPLEMENTATIONS[name] = function

    def __call__(self, *numbers, **settings) -> list:
        dtype = common_type(*numbers)
        if IS_ORDINARY:
            return self.expand(*(as_dtype(x, dtype) for x in numbers), **settings)
        return self.primitive.bind(*(as_dtype(x, dtype) for x in numbers), **settings)

    def expand(self, *numbers, **settings) -> list:
        """Return the results, computed by the operations of the expansion."""
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
        """Return the expansion as a function of the chosen arrays; the others are constant."""

        def of(*own):
            rest = iter(own)
            return self.expand(*(next(rest) if mine else x for x, mine in zip(numbers, chosen)), **settings)

        return of

    @under_usual_settings
    def _pushed(self, numbers, changes, **settings):
        if self.change is not None:
            values, found = self._changed(numbers, [None if type(d) is Zero else d for d in changes], settings)
            return values, [Zero(jax.typeof(x).to_tangent_aval()) if d is None else d for x, d in zip(values, found)]
        moves = [type(d) is not Zero for d in changes]
        moving, moved = ([x for x, move in zip(each, moves) if move] for each in (numbers, changes))
        return jax.jvp(self._of_some(numbers, moves, settings), moving, moved)

    def _changed(self, numbers: list, changes: list, settings: dict) -> tuple[list, list]:
        """Return results and their tangents by the rule; None stands for zero."""
        assert self.change is not None
        values, found = self.change(self, numbers, changes, **settings)
        return values, [_of_all(d, value) for d, value in zip(found, values)]

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


def is_macro(name: str) -> bool:
    """Return whether a primitive of this name consists of others."""
    return name in _OPERATIONS


def changed(name: str, numbers: list, changes: list, settings: dict, through: Callable) -> tuple[list, list]:
    """Return the results of a macro primitive, and their tangents.

    **Arguments:**

    - `numbers`: scalars. `changes`: their tangents, which may have one more axis; None is zero.
    - `through`: `through(program, numbers, changes)` differentiates the expansion where there is no rule.
    """
    operation = _OPERATIONS[name]
    if operation.change is None:
        return through(expand(name, numbers, settings), numbers, changes)
    return operation._changed(numbers, changes, settings)


def _of_all(change, value):
    """Return a tangent broadcast to the shape of its value; it may have one more axis."""
    return None if change is None else jnp.broadcast_to(change, jnp.broadcast_shapes(jnp.shape(change), value.shape))


def expand(name: str, operands: list, settings: dict) -> ClosedJaxpr:
    """Return the expansion of a macro primitive for operands of these types, as a jaxpr."""
    return _program(name, *_kept_by(operands, settings))


def _kept_by(operands: Sequence, settings: dict) -> tuple[tuple, tuple, bool]:
    """Return the key of an expansion: types of operands, settings, and the precision, which integers follow."""
    return tuple((x.shape, x.dtype) for x in operands), tuple(settings.items()), setting("jax_enable_x64")


@functools.lru_cache(maxsize=4096)
@under_usual_settings
def _program(name: str, kinds: tuple, settings: tuple[tuple[str, Hashable], ...], double: bool) -> ClosedJaxpr:
    like = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
    # The jaxpr is cached, so it is traced outside of any mesh, with hints for any compiler.
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())), with_hints(True):
        return jax.make_jaxpr(functools.partial(_OPERATIONS[name].expand, **dict(settings)))(*like)


@functools.lru_cache(maxsize=4096)
def _called(name: str, kinds: tuple, settings: tuple, double: bool) -> Callable:
    """Return the expansion as a jitted function, which a module holds once."""
    return jax.jit(jaxpr_as_fun(_program(name, kinds, settings, double)))


@under_usual_settings
def _lowered(name: str, context, *operands, **settings):
    return mlir.lower_fun(_called(name, *_kept_by(context.avals_in, settings)))(without_mesh(context), *operands)


@under_usual_settings
def _batched(primitive: Primitive, operands, axes, **settings) -> tuple[list, list]:
    """Batch a macro primitive: operands broadcast, so that an unmapped one needs no axis."""
    most = max(jnp.ndim(x) - (axis is not None) for x, axis in zip(operands, axes))

    def moved(x, axis):
        if axis is None:
            return x
        x = jnp.moveaxis(x, axis, 0)
        return x.reshape(x.shape[0], *[1] * (most + 1 - x.ndim), *x.shape[1:])

    found = primitive.bind(*map(moved, operands, axes), **settings)
    return found, [0] * len(found)
