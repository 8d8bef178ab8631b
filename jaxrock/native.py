"""Programs of one lane as machine code for the vector unit of a CPU. Needs llvmlite.

XLA's CPU backend makes a loop over all lanes of every few operations, and hands arrays from loop to loop through
memory. Here a program runs from its first to its last operation for a few lanes at a time, one in each element of a
vector register, and then for the next few. XLA calls it as a foreign function.
"""

import ctypes
import functools
import hashlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from llvmlite import binding, ir

from jaxrock._keep import nothing_kept
from jaxrock.emitter import emit, is_long

_POINTER, _I32, _I64 = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)


def run(function: Callable, leaves: list, shared: list[bool]) -> list:
    """`function(leaves)` (a list) for many lanes: leaves that are not `shared` have a leading axis, and so do results.

    Raises `Unsupported` if the function does what is not known in `operations`.
    """
    shapes = [x.shape if same else x.shape[1:] for x, same in zip(leaves, shared)]
    like = [jax.ShapeDtypeStruct(shape, x.dtype) for shape, x in zip(shapes, leaves)]
    with nothing_kept():
        program = jax.make_jaxpr(lambda leaves: function(leaves))(like)
    machine = _machine()
    name = _registered(emit(program, shared, machine.lanes, "program"))
    size = next(x.shape[0] for x, same in zip(leaves, shared) if not same)
    more = -size % machine.lanes

    def laid_out(x, same):
        if same:
            return x
        x = jnp.concatenate([x, jnp.repeat(x[-1:], more, axis=0)]) if more else x
        return x if is_long(x.shape[1:]) else jnp.moveaxis(x, 0, -1)

    results = [jax.ShapeDtypeStruct((*v.aval.shape, size + more), v.aval.dtype) for v in program.jaxpr.outvars]
    found = jax.ffi.ffi_call(name, results)(np.int32(size + more), *map(laid_out, leaves, shared))
    return [jnp.moveaxis(x, -1, 0)[:size] for x in found]


class _Machine:
    """LLVM for this machine."""

    def __init__(self):
        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        features = binding.get_host_cpu_features()
        self.lanes = 8 if features.get("avx512f") else 4
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


@functools.cache
def _machine() -> _Machine:
    return _Machine()


def _registered(module: ir.Module) -> str:
    """The name under which XLA finds the function of a module: made of its text, so that compiled programs that a
    cache keeps find it again."""
    _add_handler(module)
    return _register(str(module))


@functools.cache
def _register(text: str) -> str:
    name = "jaxrock_" + hashlib.sha256(text.encode()).hexdigest()[:20]
    address = _machine().compile(text.replace("jaxrock_handler", name), name)
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    jax.ffi.register_ffi_target(name, new(address, b"xla._CUSTOM_CALL_TARGET", None), platform="cpu")
    return name


def _add_handler(module: ir.Module) -> None:
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

    def at(pointer, offset, kind=_POINTER):
        return b.bitcast(b.gep(pointer, [_I64(offset)]), kind.as_pointer())

    extension = b.load(at(frame, 8))
    with b.if_then(b.icmp_unsigned("!=", extension, ir.Constant(_POINTER, None))):
        with b.if_then(b.icmp_signed("==", b.load(at(extension, 8, _I32)), _I32(1))):
            version = b.load(at(b.load(at(frame, 16)), 32, _I64))
            b.store(version, at(b.load(at(extension, 24)), 24, _I64))
            b.ret(ir.Constant(_POINTER, None))
    with b.if_then(b.icmp_signed("==", b.load(at(frame, 32, _I32)), _I32(3))):
        tables = []
        for offset, count_at in ((112, 96), (72, 56)):
            count = b.load(at(frame, count_at, _I64))
            buffers = b.bitcast(b.load(at(frame, offset)), _POINTER.as_pointer())
            table = b.alloca(_POINTER, count)
            with _counted(b, count) as i:
                data = b.load(at(b.load(b.gep(buffers, [i])), 24))
                b.store(data, b.gep(table, [i]))
            tables.append(table)
        b.call(program, tables)
    b.ret(ir.Constant(_POINTER, None))


class _counted:
    """A loop over 0, 1, ... below a count."""

    def __init__(self, builder: ir.IRBuilder, count):
        self.b, self.count = builder, count

    def __enter__(self):
        b, before = self.b, self.b.block
        self.head, inside, self.after = (b.append_basic_block() for _ in range(3))
        b.branch(self.head)
        b.position_at_end(self.head)
        self.index = b.phi(_I64)
        self.index.add_incoming(_I64(0), before)
        b.cbranch(b.icmp_signed("<", self.index, self.count), inside, self.after)
        b.position_at_end(inside)
        return self.index

    def __exit__(self, *_):
        self.index.add_incoming(self.b.add(self.index, _I64(1)), self.b.block)
        self.b.branch(self.head)
        self.b.position_at_end(self.after)
