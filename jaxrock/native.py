"""Programs of one lane as machine code for the vector unit of a CPU. Needs llvmlite.

XLA's CPU backend makes a loop over all lanes of every few operations, and hands arrays from loop to loop through
memory. Here a program runs from its first to its last operation for a few lanes at a time, one in each element of a
vector register, and then for the next few. XLA calls it as a foreign function.
"""

import ctypes
import functools
import hashlib
import math
import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend.core import Literal
from llvmlite import binding, ir

from jaxrock._keep import nothing_kept
from jaxrock.emitter import SMALL, is_known
from jaxrock.kernels import emit, emit_loop, is_long
from jaxrock.programs import ahead, around_loop, computed

_POINTER, _I32, _I64 = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)


def run(function: Callable, leaves: list, shared: list[bool], refilled: bool = False, count=None) -> list:
    """`function(leaves)` (a list) for many lanes: leaves that are not `shared` have a leading axis, and so do results.

    `refilled`: in the function's one loop a lane that is done does not wait for others. `count`: of how many lanes, the
    first, there have to be results (at least 1; known at run time only).
    Raises `Unsupported` if the function does what is not known in `operations`.
    """
    shapes = [x.shape if same else x.shape[1:] for x, same in zip(leaves, shared)]
    like = [jax.ShapeDtypeStruct(shape, x.dtype) for shape, x in zip(shapes, leaves)]
    with nothing_kept():
        program = jax.make_jaxpr(lambda leaves: function(leaves))(like)
    values = dict(zip(program.jaxpr.invars, leaves))
    once, each, rest = ahead(program, shared, is_known, lambda v: math.prod(v.aval.shape) > SMALL)
    computed(once, values, batched=False)
    computed(each, values, batched=True)

    size = next(x.shape[0] for x, same in zip(leaves, shared) if not same)
    more = -size % _machine().lanes
    sizes = jnp.stack([jnp.int32(size + more), jnp.asarray(size if count is None else count, jnp.int32)])
    own = {v for v, same in zip(program.jaxpr.invars, shared) if not same} | set(each.outputs)
    for v in [v for v in rest.inputs if v in own]:
        x = values[v]
        x = jnp.concatenate([x, jnp.repeat(x[-1:], more, axis=0)]) if more else x
        values[v] = x if is_long(v.aval.shape) else jnp.moveaxis(x, 0, -1)
    for part in around_loop(rest) if refilled else [rest]:
        is_loop = refilled and [e.primitive.name for e in part.program.jaxpr.eqns] == ["while"]
        name = registered(part.program, [v not in own for v in part.inputs], emit_loop if is_loop else emit)
        shapes = [(*v.aval.shape, size + more) for v in part.outputs]
        results = [jax.ShapeDtypeStruct(shape, v.aval.dtype) for shape, v in zip(shapes, part.outputs)]
        found = jax.ffi.ffi_call(name, results)(sizes, *(values[v] for v in part.inputs))
        values.update((v, x) for v, x in zip(part.outputs, found) if not isinstance(v, Literal))
        own.update(v for v in part.outputs if not isinstance(v, Literal))
    return [jnp.moveaxis(x, -1, 0)[:size] for x in found]


class _Machine:
    """LLVM for this machine."""

    def __init__(self):
        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        features = binding.get_host_cpu_features()
        self.lanes = 16 if features.get("avx512f") else 8  # two registers: one computes while the other waits
        self._target = binding.Target.from_default_triple().create_target_machine(
            cpu=binding.get_host_cpu_name(), features=features.flatten(), opt=3
        )
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), self._target)

    def compile(self, text: str, name: str) -> int:
        """Address of a function of a module."""
        code = binding.parse_assembly(text)
        code.verify()
        options = binding.create_pipeline_tuning_options(speed_level=2)
        builder = binding.create_pass_builder(self._target, options)
        builder.getModulePassManager().run(code, builder)
        self._engine.add_module(code)
        self._engine.finalize_object()
        return self._engine.get_function_address(name)


_one_at_a_time = threading.RLock()


def _machine() -> _Machine:
    with _one_at_a_time:  # of two machines one would be freed, with all that it has compiled
        return _made()


@functools.cache
def _made() -> _Machine:
    return _Machine()


_registered = set()


def registered(program, shared: list[bool], emit: Callable = emit) -> str:
    """The name under which XLA finds the machine code of a program: made of its text, so that compiled programs that a
    cache keeps find it again."""
    module = emit(program, shared, _machine().lanes, "program")
    _add_handler(module, len(program.jaxpr.outvars), 1 + len(shared))
    text = str(module)
    name = "jaxrock_" + hashlib.sha256(text.encode()).hexdigest()[:20]
    with _one_at_a_time:
        if name not in _registered:
            address = _machine().compile(text.replace("jaxrock_handler", name), name)
            new = ctypes.pythonapi.PyCapsule_New
            new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
            jax.ffi.register_ffi_target(name, new(address, b"xla._CUSTOM_CALL_TARGET", None), platform="cpu")
            _registered.add(name)
    return name


def _add_handler(module: ir.Module, outputs: int, inputs: int) -> None:
    """Add the function that XLA calls: `handler(frame)`, by the offsets of XLA's C interface for foreign functions.

    Frame: at 8 extensions, at 16 the interface (its version at 32), at 32 the stage, at 72 the arguments, at 112 the
    results; a buffer has its data at 24. Extension: at 8 its kind, at 24 what it is about. In order to learn of its
    version XLA calls it with an extension of kind 1, to which it has to be written at 24.
    """
    handler = ir.Function(module, ir.FunctionType(_POINTER, [_POINTER]), "jaxrock_handler")
    program = module.globals["program"]
    program.linkage = "internal"
    b = ir.IRBuilder(handler.append_basic_block("entry"))
    (frame,) = handler.args
    done = ir.Constant(_POINTER, None)

    def at(pointer, offset, kind=_POINTER):
        return b.load(b.bitcast(b.gep(pointer, [_I64(offset)]), kind.as_pointer()))

    extension = at(frame, 8)
    with b.if_then(b.icmp_unsigned("!=", extension, done)):
        with b.if_then(b.icmp_signed("==", at(extension, 8, _I32), _I32(1))):
            version = at(at(frame, 16), 32, _I64)
            b.store(version, b.bitcast(b.gep(at(extension, 24), [_I64(24)]), _I64.as_pointer()))
            b.ret(done)
    with b.if_then(b.icmp_signed("==", at(frame, 32, _I32), _I32(3))):
        tables = []
        for offset, count in ((112, outputs), (72, inputs)):
            table = b.alloca(_POINTER, count)
            for i in range(count):
                b.store(at(at(at(frame, offset), 8 * i), 24), b.gep(table, [_I32(i)]))
            tables.append(table)
        b.call(program, tables)
    b.ret(done)
