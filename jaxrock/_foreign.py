"""XLA's C interface for foreign functions, and one such function: a check that raises.

`ctypes` lays the structures out as the compiler of XLA does; their fields stand as in the header that jaxlib ships.
"""

import ctypes
import functools
import re
import threading
from pathlib import Path
from typing import Any

import jax
import jaxlib

_KNOWN = 0  # the major version of the interface; minor ones only add to its ends
EXECUTE, METADATA = 3, 1  # the stage that computes; the kind of extension that asks for the version
_INVALID_ARGUMENT = 3  # a kind of error


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
    """With an error, which XLA may free."""

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
    """Return whether XLA's interface is the one that is written down here, by the header of the jaxlib that is
    installed."""
    header = Path(jaxlib.__file__).parent / "include" / "xla" / "ffi" / "api" / "c_api.h"
    if not header.exists():
        return True  # nothing says otherwise, and XLA asks for the version itself
    found = re.search(r"define XLA_FFI_API_MAJOR (\d+)", header.read_text())
    return found is not None and int(found[1]) == _KNOWN


# ---------------------------------------------------------------------------------------------- a check that raises

CHECK = "jaxrock_check"  # of a flag: an error with the attribute as its message where it is set, else what was given


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
    ctypes.c_bool.from_address(found).value = has_failed  # first: where no error can be made, what failed is marked
    if not has_failed:
        return None
    text = _first(frame.attributes.values, _Text)
    size = _Complaint.code.offset + _Complaint.code.size  # XLA counts no padding
    complaint = _Complaint(size, None, ctypes.string_at(text.start, text.size), _INVALID_ARGUMENT)
    return Interface.from_address(frame.api).create_error(ctypes.byref(complaint))


def _first(table: int, kind: Any) -> Any:
    """The first structure of a table of addresses."""
    return kind.from_address(ctypes.c_void_p.from_address(table).value)


def has_check() -> bool:
    """Return whether XLA's CPU backend knows `CHECK`, from now on."""
    with _one_at_a_time:
        return _registered() is not None


_one_at_a_time = threading.Lock()


@functools.cache
def _registered() -> Any:
    """What XLA calls, which has to stay where it is; None where there is no such thing."""
    if not is_known():
        return None
    try:
        called = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(_check)
    except (OSError, MemoryError):  # a system that lets nobody write functions
        return None
    register(CHECK, ctypes.cast(called, ctypes.c_void_p).value)
    return called


def register(name: str, address: int | None) -> None:
    """Tell XLA's CPU backend where a function is."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    jax.ffi.register_ffi_target(name, new(address, b"xla._CUSTOM_CALL_TARGET", None), platform="cpu")
