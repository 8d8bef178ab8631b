"""XLA's C interface for foreign functions (FFI), and one such function: a check that raises.

`ctypes` lays out the structures as a C compiler does. Their fields are in the order of the header that jaxlib ships.
"""

import ctypes
import functools
import re
import threading
from pathlib import Path
from typing import Any

import jax
import jaxlib

_KNOWN = 0  # major version of the interface; minor versions only append fields
EXECUTE, METADATA = 3, 1  # stage of execution; type of the extension that asks for the version
_INVALID_ARGUMENT = 3  # error code


class Extension(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("type", ctypes.c_int), ("next", ctypes.c_void_p)]


class Version(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p),
                ("major_version", ctypes.c_int), ("minor_version", ctypes.c_int)]  # fmt: skip


class Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("api_version", Version), ("traits", ctypes.c_uint32)]


class MetadataExtension(ctypes.Structure):
    _fields_ = [("base", Extension), ("metadata", ctypes.c_void_p)]


class _Complaint(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("message", ctypes.c_char_p),
                ("code", ctypes.c_int)]  # fmt: skip


_Complain = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Complaint))


class Task(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("context", ctypes.c_void_p),
                ("task", ctypes.c_void_p), ("data", ctypes.c_void_p)]  # fmt: skip


class Done(ctypes.Structure):
    """Arguments of `destroy_error`, by which XLA frees an error."""

    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("error", ctypes.c_void_p)]


class Interface(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("api_version", Version),
                ("internal", ctypes.c_void_p), ("create_error", _Complain), ("tell_error", ctypes.c_void_p),
                ("destroy_error", ctypes.c_void_p), ("others", ctypes.c_void_p * 8),
                ("schedule", ctypes.c_void_p)]  # fmt: skip


class Buffer(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("dtype", ctypes.c_int),
                ("data", ctypes.c_void_p)]  # fmt: skip


class Buffers(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("size", ctypes.c_int64),
                ("types", ctypes.c_void_p), ("buffers", ctypes.c_void_p)]  # fmt: skip


class _Text(ctypes.Structure):
    _fields_ = [("start", ctypes.c_void_p), ("size", ctypes.c_size_t)]


class _Attributes(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("size", ctypes.c_int64),
                ("types", ctypes.c_void_p), ("names", ctypes.c_void_p), ("values", ctypes.c_void_p)]  # fmt: skip


class Frame(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p), ("api", ctypes.c_void_p),
                ("ctx", ctypes.c_void_p), ("stage", ctypes.c_int), ("args", Buffers), ("rets", Buffers),
                ("attributes", _Attributes)]  # fmt: skip


def is_known() -> bool:
    """Return whether the header of the installed jaxlib has this major version; True without a header."""
    header = Path(jaxlib.__file__).parent / "include" / "xla" / "ffi" / "api" / "c_api.h"
    if not header.exists():
        return True  # XLA asks for the version itself
    found = re.search(r"define XLA_FFI_API_MAJOR (\d+)", header.read_text())
    return found is not None and int(found[1]) == _KNOWN


# ---------------------------------------------------------------------------------------------- a check that raises

CHECK = "jaxrock_check"  # takes a flag: fails with the attribute `message` if it is set, and returns it otherwise


def _check(address: int) -> int | None:
    frame = Frame.from_address(address)
    if frame.extension_start:
        extension = MetadataExtension.from_address(frame.extension_start)
        if extension.base.type == METADATA:  # XLA asks for the version
            version, known = (
                each.from_address(place).api_version
                for each, place in ((Metadata, extension.metadata), (Interface, frame.api))
            )
            version.major_version, version.minor_version = known.major_version, known.minor_version
            return None
    if frame.stage != EXECUTE:
        return None
    failed, found = (_first(each.buffers, Buffer).data for each in (frame.args, frame.rets))
    has_failed = ctypes.c_bool.from_address(failed).value
    ctypes.c_bool.from_address(found).value = has_failed  # so that failed values are marked where no error can be made
    if not has_failed:
        return None
    text = _first(frame.attributes.values, _Text)
    size = _Complaint.code.offset + _Complaint.code.size  # XLA's size excludes padding
    complaint = _Complaint(size, None, ctypes.string_at(text.start, text.size), _INVALID_ARGUMENT)
    return Interface.from_address(frame.api).create_error(ctypes.byref(complaint))


def _first(table: int, kind: Any) -> Any:
    """Return the first structure of a table of addresses."""
    return kind.from_address(ctypes.c_void_p.from_address(table).value)


def has_check() -> bool:
    """Register `CHECK` at XLA's CPU backend if need be, and return whether it is."""
    with _one_at_a_time:
        return _registered() is not None


_one_at_a_time = threading.Lock()


@functools.cache
def _registered() -> Any:
    """Return the callback of `CHECK`, which must stay alive; None where it cannot be made."""
    if not is_known():
        return None
    try:
        called = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(_check)
    except (OSError, MemoryError):  # a system that forbids executable memory
        return None
    register(CHECK, ctypes.cast(called, ctypes.c_void_p).value)
    return called


def register(name: str, address: int | None) -> None:
    """Register a function at XLA's CPU backend, by its address."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    jax.ffi.register_ffi_target(name, new(address, b"xla._CUSTOM_CALL_TARGET", None), platform="cpu")
