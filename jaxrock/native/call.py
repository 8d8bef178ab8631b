"""Programs of one lane as machine code for the vector unit of a CPU. Needs llvmlite.

XLA's CPU backend makes a loop over all lanes of every few operations, and hands arrays from loop to loop through
memory. Here a program runs from its first to its last operation for a few lanes at a time, one in each element of a
vector register, and then for the next few. XLA calls it as a foreign function.
"""

import ctypes
import functools
import hashlib
import math
import os
import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend.core import Literal
from llvmlite import binding, ir

from jaxrock.native.emitter import SMALL, is_known
from jaxrock.native.kernels import emit, emit_loop, is_long
from jaxrock.native.partition import ahead, around_loop, computed
from jaxrock.numerics.xla_cpu import nothing_kept

_ROOM, _WANTED, _THREADS = range(3)  # what the first input of a program tells
_SHARE = 64  # lanes that are worth a thread
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
    told = size + more, size if count is None else count, _threads()
    sizes = jnp.stack([jnp.asarray(x, jnp.int32) for x in told])
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
        arrays = jax.ffi.ffi_call(name, results)(sizes, *(values[v] for v in part.inputs))
        values.update((v, x) for v, x in zip(part.outputs, arrays) if not isinstance(v, Literal))
        own.update(v for v in part.outputs if not isinstance(v, Literal))
    return [jnp.moveaxis(x, -1, 0)[:size] for x in arrays]


def _threads() -> int:
    """How many threads run a program: all cores of this process, dealt to the devices that run it at the same time."""
    if not _HAS_THREADS:
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    together = min(jax.sharding.get_abstract_mesh().size, len(jax.local_devices(backend="cpu")))
    return max(1, cores // max(1, together))  # none outside of a `shard_map`


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


_HAS_THREADS = os.name == "posix"
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
        _in_threads(b, program, *tables)
    b.ret(done)


def _in_threads(b: ir.IRBuilder, program: ir.Function, outputs, inputs) -> None:
    """Call a program in this thread and, where there are many lanes, at the same time in others."""
    module = b.module
    worker = ir.Function(module, ir.FunctionType(_POINTER, [_POINTER]), "worker")
    worker.linkage = "internal"
    inner = ir.IRBuilder(worker.append_basic_block("entry"))
    passed = inner.bitcast(worker.args[0], _POINTER.as_pointer())
    given = [inner.load(inner.gep(passed, [_I32(i)])) for i in range(3)]
    inner.call(program, [inner.bitcast(x, kind) for x, kind in zip(given, program.ftype.args)])
    inner.ret(ir.Constant(_POINTER, None))

    message, following = b.alloca(_POINTER, 3), b.alloca(_I64)
    b.store(_I64(0), following)
    for i, x in enumerate((outputs, inputs, following)):
        b.store(b.bitcast(x, _POINTER), b.gep(message, [_I32(i)]))
    message = b.bitcast(message, _POINTER)
    if not _HAS_THREADS:
        b.call(worker, [message])
        return
    sizes = b.bitcast(b.load(inputs), _I32.as_pointer())
    wanted, threads = (b.sext(b.load(b.gep(sizes, [_I32(i)])), _I64) for i in (_WANTED, _THREADS))
    most = b.sdiv(b.sub(wanted, _I64(1)), _I64(_SHARE))
    threads = b.sub(threads, _I64(1))
    helpers = b.select(b.icmp_signed("<", most, threads), most, threads)
    handles = b.alloca(_I64, helpers)
    create = _outside(module, "pthread_create", _I64.as_pointer(), _POINTER, worker.type, _POINTER)
    join = _outside(module, "pthread_join", _I64, _POINTER.as_pointer())
    nothing = ir.Constant(_POINTER, None)

    def begin(number):
        # If there is no thread to be had, the others do its work.
        failed = b.call(create, [b.gep(handles, [number]), nothing, worker, message])
        return b.icmp_signed("==", failed, _I32(0))

    def end(number):
        b.call(join, [b.load(b.gep(handles, [number])), ir.Constant(_POINTER.as_pointer(), None)])
        return ir.Constant(ir.IntType(1), True)

    begun = _count_up(b, helpers, begin)
    b.call(worker, [message])
    _count_up(b, begun, end)


def _outside(module: ir.Module, name: str, *kinds) -> ir.Function:
    """A function of the system that returns an int."""
    return ir.Function(module, ir.FunctionType(_I32, kinds), name)


def _count_up(b: ir.IRBuilder, size, act: Callable):
    """`act(number)` from 0 to `size`, or until it is false; the number where it ends."""
    before, head, inside, after = b.block, *(b.append_basic_block(name) for name in ("next", "act", "done"))
    b.branch(head)
    b.position_at_end(head)
    number = b.phi(_I64)
    b.cbranch(b.icmp_signed("<", number, size), inside, after)
    b.position_at_end(inside)
    goes_on = act(number)
    following = b.add(number, _I64(1))
    number.add_incoming(_I64(0), before)
    number.add_incoming(following, b.block)
    last = b.block
    b.cbranch(goes_on, head, after)
    b.position_at_end(after)
    end = b.phi(_I64)
    end.add_incoming(number, head)
    end.add_incoming(number, last)
    return end
