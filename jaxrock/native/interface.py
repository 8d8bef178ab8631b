"""The function that XLA calls, by the structures of its C interface for foreign functions. Needs llvmlite."""

import ctypes
import os
import sys
from collections.abc import Callable

from llvmlite import ir

from jaxrock._foreign import (
    EXECUTE,
    METADATA,
    Buffer,
    Buffers,
    Extension,
    Frame,
    Interface,
    Metadata,
    MetadataExtension,
    Version,
)

HAS_THREADS = os.name == "posix"
ON_LINUX = sys.platform == "linux"
_WANTED, _THREADS = 1, 2  # what the first input of a program tells
_SHARE = 64  # lanes that are worth a thread
_CORES = 1024  # that a set of cores has room for
_POINTER, _I32, _I64 = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)


def add_handler(module: ir.Module, outputs: int, inputs: int) -> None:
    """Add the function that XLA calls, `jaxrock_handler(frame)`, for the program of a module.

    In order to learn of its version XLA calls it with an extension, to which the version has to be written.
    """
    handler = ir.Function(module, ir.FunctionType(_POINTER, [_POINTER]), "jaxrock_handler")
    program = module.globals["program"]
    program.linkage = "internal"
    b = ir.IRBuilder(handler.append_basic_block("entry"))
    (frame,) = handler.args
    done = ir.Constant(_POINTER, None)

    def at(pointer, offset, kind=_POINTER):
        return b.load(b.bitcast(b.gep(pointer, [_I64(offset)]), kind.as_pointer()))

    version = Metadata.api_version.offset + Version.major_version.offset
    extension = at(frame, Frame.extension_start.offset)
    with b.if_then(b.icmp_unsigned("!=", extension, done)):
        with b.if_then(b.icmp_signed("==", at(extension, Extension.type.offset, _I32), _I32(METADATA))):
            interface = at(frame, Frame.api.offset)
            known = at(interface, Interface.api_version.offset + Version.major_version.offset, _I64)  # both numbers
            about = at(extension, MetadataExtension.metadata.offset)
            b.store(known, b.bitcast(b.gep(about, [_I64(version)]), _I64.as_pointer()))
            b.ret(done)
    with b.if_then(b.icmp_signed("==", at(frame, Frame.stage.offset, _I32), _I32(EXECUTE))):
        tables = []
        for where, count in ((Frame.rets, outputs), (Frame.args, inputs)):
            table, buffers = b.alloca(_POINTER, count), at(frame, where.offset + Buffers.buffers.offset)
            for i in range(count):
                buffer = at(buffers, ctypes.sizeof(ctypes.c_void_p) * i)
                b.store(at(buffer, Buffer.data.offset), b.gep(table, [_I32(i)]))
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
    if not HAS_THREADS:
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

    elsewhere = _other_cores(b) if ON_LINUX else None

    def begin(number):
        # If there is no thread to be had, the others do its work.
        failed = b.call(create, [b.gep(handles, [number]), nothing, worker, message])
        begun = b.icmp_signed("==", failed, _I32(0))
        if elsewhere is not None:
            with b.if_then(begun):
                elsewhere(b.load(b.gep(handles, [number])))
        return begun

    def end(number):
        b.call(join, [b.load(b.gep(handles, [number])), ir.Constant(_POINTER.as_pointer(), None)])
        return ir.Constant(ir.IntType(1), True)

    begun = _count_up(b, helpers, begin)
    b.call(worker, [message])
    _count_up(b, begun, end)


def _other_cores(b: ir.IRBuilder) -> Callable:
    """A function that sends a thread away from the core that this one runs on, if there is another.

    Or else Linux may leave it where it was made, to wait there for its turn: for 2.5 of 3 ms that it is needed, on 2
    cores.
    """
    module, size = b.module, _CORES // 8
    bits = b.bitcast(b.alloca(_I64, _CORES // 64), _POINTER)
    ask = _outside(module, "sched_getaffinity", _I32, _I64, _POINTER)
    send = _outside(module, "pthread_setaffinity_np", _I64, _I64, _POINTER)
    known = b.icmp_signed("==", b.call(ask, [_I32(0), _I64(size), bits]), _I32(0))
    here = b.zext(b.call(_outside(module, "sched_getcpu"), []), _I64)  # -1 where it is not known
    known = b.and_(known, b.icmp_unsigned("<", here, _I64(_CORES)))
    with b.if_then(known):
        byte = b.gep(bits, [b.lshr(here, _I64(3))])
        own = b.shl(ir.IntType(8)(1), b.trunc(b.and_(here, _I64(7)), ir.IntType(8)))
        b.store(b.and_(b.load(byte), b.not_(own)), byte)

    def elsewhere(thread):
        with b.if_then(known):
            b.call(send, [thread, _I64(size), bits])  # refused where no core is left

    return elsewhere


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
