"""Lower a `LaneFunction`: reuse its cached program where there can be one, and otherwise trace its `Lanes`.

    compiled                                    lowered to
    --------                                    ----------
    by a user's `jax.export`                    XLA's lanes, traced here: other machines lack the machine code
    for an accelerator                          XLA's lanes, traced here
    for this CPU: without a key, without a      lanes (machine code, or XLA's), traced here
      cache folder, or not exportable
    for this CPU otherwise                      lanes that this session or another exported: copied into the
                                                  module, or called where they call LAPACK

`lanes` describes the lanes. A `LaneFunction` within an exported one (`_exported`) is lowered here, too, and keeps its
machine code.
"""

import contextvars
import json
import logging
from collections.abc import Sequence
from typing import Any

import jax
from jax.extend.mlir import deserialize_portable_artifact, ir
from jax.extend.mlir.dialects import func
from jax.interpreters import mlir

from jaxrock._core.settings import under_usual_settings
from jaxrock.compiler.cache import key, store
from jaxrock.compiler.primitive.lane_function import LaneFunction
from jaxrock.compiler.primitive.lanes import Lanes
from jaxrock.compiler.primitive.sharding_types import without_mesh
from jaxrock.compiler.tracing import while_tracing

_LOG = logging.getLogger("jaxrock")
# Names of the machine code that the current export calls; None outside of an export.
_called: contextvars.ContextVar[list[str] | None] = contextvars.ContextVar("called", default=None)


@while_tracing
@under_usual_settings
def lowered(context, *leaves, fn: LaneFunction, is_batched: tuple[bool, ...], size: int | None, on_cpu: bool):
    """Lower `lane_map_p` of `bind`; the rule that JAX calls."""
    mesh = getattr(context.module_context.axis_context, "mesh", None)
    exported = getattr(context.module_context.lowering_parameters, "for_export", False)
    portable = exported and _called.get() is None  # by the user, for machines that may lack the machine code
    lanes = Lanes(fn, is_batched, size, on_cpu, getattr(mesh, "size", 1) or 1, portable)
    kept, codes = _kept(lanes, context.avals_in) or (None, lanes.codes())
    if (called := _called.get()) is not None:
        called.extend(codes)
    if kept is not None and b"lapack_" not in kept.mlir_module_serialized:
        return _inlined(kept, context, leaves)
    return mlir.lower_fun(lanes if kept is None else kept.call)(without_mesh(context), *leaves)


def _inlined(program: jax.export.Exported, context, leaves) -> Sequence:
    """Copy an exported program into the module, as `program.call` does.

    `program.call` initialises LAPACK first, which takes longer than all the rest.
    """
    with context.module_context.module.context:
        module = deserialize_portable_artifact(program.mlir_module_serialized)
    main: Any = ir.SymbolTable(module.operation)["main"]
    whole = context.module_context
    name = mlir.merge_mlir_modules(whole.module, "jaxrock_kept", module, dst_symtab=whole.symbol_table)
    used = [leaves[i] for i in program.module_kept_var_idx]
    return func.CallOp(main.type.results, ir.FlatSymbolRefAttr.get(name), used).results


def _kept(lanes: Lanes, leaves) -> tuple[jax.export.Exported, list[str]] | None:
    """Return the exported program, of this session or another, and the names of the machine code that it calls.

    None where it cannot be cached.
    """
    told = lanes.fn.key
    if told is None or not lanes.on_cpu or lanes.portable or store.folder() is None or not key.still_hold(told):
        return None
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    name = store.name_of(
        key.versions(), key.settings(), lanes.machine, told, lanes.is_batched, lanes.size, lanes.threads,
        [(x.shape, x.dtype) for x in shapes],
    )  # fmt: skip
    content = store.read("lowered", name)
    if content is not None:
        called, _, program = content.partition(b"\n")
        codes = json.loads(called)
        if all(map(lanes.found, codes)):
            return jax.export.deserialize(bytearray(program)), codes
    _LOG.info("compiling, once for this machine")
    try:
        exported, codes = _exported(lanes, shapes)
        store.write("lowered", name, json.dumps(codes).encode() + b"\n" + exported.serialize())
    except Exception as error:  # such as a callback in it, which exists in this process only
        _LOG.debug("%s is not kept: %.300s", lanes.fn, error)
        return None
    return exported, codes


def _exported(lanes: Lanes, shapes: list) -> tuple[jax.export.Exported, list[str]]:
    """Export lanes with all lane functions within them; return also the names of the machine code that they call."""
    codes = lanes.codes()
    before = _called.set(codes)
    allowed = _Called()
    try:
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            exported = jax.export.export(jax.jit(lanes), platforms=["cpu"], disabled_checks=allowed)(*shapes)
        return exported, sorted(set(codes))
    finally:
        _called.reset(before)


class _Called(Sequence):
    """Names of machine code that `jax.export` must allow, read when it checks: lowering adds to them until then."""

    def __len__(self):
        return len(_called.get())

    def __getitem__(self, index):
        return jax.export.DisabledSafetyCheck.custom_call(_called.get()[index])
