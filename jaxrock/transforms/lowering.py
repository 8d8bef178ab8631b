"""How a recipe is lowered: as it was kept, where it can be kept, and else by tracing its `Lanes` here.

    compiled                                    lowered to
    --------                                    ----------
    by a user's `jax.export`                    XLA's lanes, traced here: other machines lack our machine code
    for an accelerator                          XLA's lanes, traced here
    for this CPU: without facts, without a      lanes (machine code, or XLA's), traced here
      folder, or it cannot be exported
    for this CPU otherwise                      lanes as they were exported, in this session or another: copied into
                                                  the program, or called where they call LAPACK

What lanes are is told by `batching`. What they are exported with (`_exported`) is lowered here once more, within:
these recipes have their machine code, too.
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

from jaxrock._abstract import without_mesh
from jaxrock._settings import under_usual_settings
from jaxrock._undisturbed import undisturbed
from jaxrock.keeping import facts, folder
from jaxrock.transforms.batching import Lanes
from jaxrock.transforms.recipe import Recipe

_LOG = logging.getLogger("jaxrock")
# Names of machine code that what is lowered now calls.
_called: contextvars.ContextVar[list[str] | None] = contextvars.ContextVar("called", default=None)


@undisturbed
@under_usual_settings
def lowered(context, *leaves, recipe: Recipe, own: tuple[bool, ...], size: int | None, on_cpu: bool):
    """The rule of JAX for the primitive of `scenes`."""
    mesh = getattr(context.module_context.axis_context, "mesh", None)
    exported = getattr(context.module_context.lowering_parameters, "for_export", False)
    portable = exported and _called.get() is None  # by the user, for machines that may not have our machine code
    lanes = Lanes(recipe, own, size, on_cpu, getattr(mesh, "size", 1) or 1, portable)
    kept, codes = _kept(lanes, context.avals_in) or (None, lanes.codes())
    if (called := _called.get()) is not None:
        called.extend(codes)
    if kept is not None and b"lapack_" not in kept.mlir_module_serialized:
        return _inlined(kept, context, leaves)
    return mlir.lower_fun(lanes if kept is None else kept.call)(without_mesh(context), *leaves)


def _inlined(program: jax.export.Exported, context, leaves) -> Sequence:
    """What `program.call` is lowered to; but that gets LAPACK ready first, which takes longer than all the rest."""
    with context.module_context.module.context:
        module = deserialize_portable_artifact(program.mlir_module_serialized)
    main: Any = ir.SymbolTable(module.operation)["main"]
    whole = context.module_context
    name = mlir.merge_mlir_modules(whole.module, "jaxrock_kept", module, dst_symtab=whole.symbol_table)
    used = [leaves[i] for i in program.module_kept_var_idx]
    return func.CallOp(main.type.results, ir.FlatSymbolRefAttr.get(name), used).results


def _kept(lanes: Lanes, leaves) -> tuple[jax.export.Exported, list[str]] | None:
    """The same as it was exported, in this session or another, and the machine code that it calls; None where that
    cannot be."""
    told = lanes.recipe.facts
    if told is None or not lanes.on_cpu or lanes.portable or folder.folder() is None or not facts.still_hold(told):
        return None
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    name = folder.name_of(
        facts.versions(), facts.settings(), lanes.machine, told, lanes.own, lanes.size, lanes.threads,
        [(x.shape, x.dtype) for x in shapes],
    )  # fmt: skip
    content = folder.read("lowered", name)
    if content is not None:
        called, _, program = content.partition(b"\n")
        codes = json.loads(called)
        if all(map(lanes.found, codes)):
            return jax.export.deserialize(bytearray(program)), codes
    _LOG.info("compiling, once for this machine")
    try:
        exported, codes = _exported(lanes, shapes)
        folder.write("lowered", name, json.dumps(codes).encode() + b"\n" + exported.serialize())
    except Exception as error:  # such as a callback in it, which no other process has
        _LOG.debug("%s is not kept: %.300s", lanes.recipe, error)
        return None
    return exported, codes


def _exported(lanes: Lanes, shapes: list) -> tuple[jax.export.Exported, list[str]]:
    """A program with all that it is made of, and the names of the machine code that it calls."""
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
    """What `jax.export` is told to let pass: the machine code that has been called by the time it looks."""

    def __len__(self):
        return len(_called.get())

    def __getitem__(self, index):
        return jax.export.DisabledSafetyCheck.custom_call(_called.get()[index])
