"""Emit the function that XLA calls, with the structures of its C interface for foreign functions. Needs llvmlite."""

import ctypes

from llvmlite import ir

from jaxrock.compiler.llvm.threads import call_in_threads
from jaxrock.compiler.xla_ffi import (
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

_POINTER, _I32, _I64 = ir.IntType(8).as_pointer(), ir.IntType(32), ir.IntType(64)


def add_handler(module: ir.Module, outputs: int, inputs: int) -> None:
    """Add the function that XLA calls, `jaxrock_handler(frame)`, to a module with a function `program`.

    At registration XLA calls the handler with an extension, to which it writes the version of the interface.
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
            known = at(interface, Interface.api_version.offset + Version.major_version.offset, _I64)  # major, minor
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
        call_in_threads(b, program, tables, at(frame, Frame.api.offset), at(frame, Frame.ctx.offset))
    b.ret(done)
