"""How a recipe is lowered: machine code of our own on CPUs, where that can be, and XLA's lanes everywhere else.

What is known by its facts is exported, and kept: in another session it need not be traced again.
"""

import logging
import pickle
from collections.abc import Callable

import jax
from jax.interpreters import mlir

from jaxrock.keeping import facts, folder
from jaxrock.transforms.batching import Lanes
from jaxrock.transforms.recipe import Recipe

_LOG = logging.getLogger("jaxrock")


def lowered(context, *leaves, recipe: Recipe, own: tuple[bool, ...], size: int | None, on_cpu: bool):
    """The rule of JAX for the primitive of `scenes`."""
    mesh = getattr(context.module_context.axis_context, "mesh", None)
    lanes = Lanes(recipe, own, size, on_cpu, getattr(mesh, "size", 1) or 1)
    return mlir.lower_fun(_kept(lanes, context.avals_in) or lanes)(context, *leaves)


def _kept(lanes: Lanes, leaves) -> Callable | None:
    """The same, as it was exported in this session or another; None where that cannot be."""
    if lanes.recipe.facts is None or not lanes.on_cpu or folder.folder() is None:
        return None
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    name = folder.name_of(
        facts.versions(), facts.settings(), lanes.machine, lanes.recipe.facts, lanes.own, lanes.size, lanes.threads,
        [(x.shape, x.dtype) for x in shapes],
    )  # fmt: skip
    content = folder.read("lowered", name)
    if content is not None:
        program, codes = pickle.loads(content)
        if all(map(lanes.found, codes)):
            return jax.export.deserialize(bytearray(program)).call
    try:
        codes = lanes.codes()
        allowed = [jax.export.DisabledSafetyCheck.custom_call(code) for code in codes]
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            exported = jax.export.export(jax.jit(lanes), platforms=["cpu"], disabled_checks=allowed)(*shapes)
        folder.write("lowered", name, pickle.dumps((bytes(exported.serialize()), codes)))
    except Exception as error:  # such as a callback in it, which no other process has
        _LOG.debug("%s is not kept: %s", lanes.recipe, error)
        return None
    return exported.call
