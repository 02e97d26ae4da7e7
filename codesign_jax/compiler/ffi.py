"""XLA's foreign function interface as machine code sees it: structures, version, types.

Source: xla/ffi/api/c_api.h in `jax.ffi.include_dir()`.  The structures are those of version 0.3
(jaxlib 0.10.2), which the handlers claim; jaxlib 0.11.2 (0.4) and 0.12.0 (0.5) have the same fields
at the same places.  XLA checks the claimed version when a handler is registered.  Handlers compare
the sizes of the structures that XLA passes with those here before they read anything else.
"""

import ctypes
import functools
import re
from ctypes import c_int32, c_int64, c_uint32, c_uint64, c_void_p
from pathlib import Path

import jax

MAJOR, MINOR = 0, 3
"""The version whose layout this module describes."""


class KernelUnavailable(RuntimeError):
    """Kernels cannot run here; the message says why."""


class Extension(ctypes.Structure):
    """XLA_FFI_Extension_Base."""

    _fields_ = [("struct_size", c_uint64), ("type", c_int32), ("next", c_void_p)]


class Version(ctypes.Structure):
    """XLA_FFI_Api_Version."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("major_version", c_int32),
        ("minor_version", c_int32),
    ]


class Metadata(ctypes.Structure):
    """XLA_FFI_Metadata, as far as it is written."""

    _fields_ = [("struct_size", c_uint64), ("api_version", Version), ("traits", c_uint32)]


class MetadataExtension(ctypes.Structure):
    """XLA_FFI_Metadata_Extension."""

    _fields_ = [("extension_base", Extension), ("metadata", c_void_p)]


class Buffer(ctypes.Structure):
    """XLA_FFI_Buffer."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("dtype", c_int32),
        ("data", c_void_p),
        ("rank", c_int64),
        ("dims", c_void_p),
    ]


class Arguments(ctypes.Structure):
    """XLA_FFI_Args and XLA_FFI_Rets."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("size", c_int64),
        ("types", c_void_p),
        ("values", c_void_p),
    ]


class Attributes(ctypes.Structure):
    """XLA_FFI_Attrs."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("size", c_int64),
        ("types", c_void_p),
        ("names", c_void_p),
        ("attrs", c_void_p),
    ]


class CallFrame(ctypes.Structure):
    """XLA_FFI_CallFrame, without the future that a handler may set."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("api", c_void_p),
        ("ctx", c_void_p),
        ("stage", c_int32),
        ("args", Arguments),
        ("rets", Arguments),
        ("attrs", Attributes),
    ]


class Api(ctypes.Structure):
    """XLA_FFI_Api up to the last function that handlers call."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("api_version", Version),
        ("internal_api", c_void_p),
        ("error_create", c_void_p),
        ("error_get_message", c_void_p),
        ("error_destroy", c_void_p),
        ("handler_register", c_void_p),
        ("stream_get", c_void_p),
        ("type_register", c_void_p),
        ("execution_context_get", c_void_p),
        ("state_set", c_void_p),
        ("state_get", c_void_p),
        ("device_memory_allocate", c_void_p),
        ("device_memory_free", c_void_p),
        ("thread_pool_schedule", c_void_p),
        ("thread_pool_num_threads", c_void_p),
    ]


class ErrorCreate(ctypes.Structure):
    """XLA_FFI_Error_Create_Args."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("message", c_void_p),
        ("errc", c_int32),
    ]


class ErrorDestroy(ctypes.Structure):
    """XLA_FFI_Error_Destroy_Args."""

    _fields_ = [("struct_size", c_uint64), ("extension_start", c_void_p), ("error", c_void_p)]


class StreamGet(ctypes.Structure):
    """XLA_FFI_Stream_Get_Args."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("ctx", c_void_p),
        ("stream", c_void_p),
    ]


class Schedule(ctypes.Structure):
    """XLA_FFI_ThreadPool_Schedule_Args."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("ctx", c_void_p),
        ("task", c_void_p),
        ("data", c_void_p),
    ]


class NumThreads(ctypes.Structure):
    """XLA_FFI_ThreadPool_NumThreads_Args; the number goes to an address."""

    _fields_ = [
        ("struct_size", c_uint64),
        ("extension_start", c_void_p),
        ("ctx", c_void_p),
        ("num_threads", c_void_p),
    ]


METADATA = 1
"""XLA_FFI_Extension_Metadata: XLA asks a handler for the version that it was written for."""

INVALID_ARGUMENT, RESOURCE_EXHAUSTED, INTERNAL = 3, 8, 13
"""Codes of errors (XLA_FFI_Error_Code)."""

DTYPES = {
    "bool": 1,
    "int8": 2,
    "int16": 3,
    "int32": 4,
    "int64": 5,
    "uint8": 6,
    "uint16": 7,
    "uint32": 8,
    "uint64": 9,
    "float16": 10,
    "float32": 11,
    "float64": 12,
    "bfloat16": 16,
}
"""XLA_FFI_DataType by NumPy's name."""


def size(structure: type[ctypes.Structure]) -> int:
    """Size of a structure as XLA states it: to the end of its last field, without padding."""
    field = getattr(structure, structure._fields_[-1][0])
    return field.offset + field.size


def header() -> Path:
    """The interface's header of the installed jaxlib."""
    return Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"


@functools.cache
def installed_version() -> tuple[int, int]:
    """Major and minor version of the installed jaxlib's interface.

    Raises:
      KernelUnavailable: If its header is missing or states none.
    """
    try:
        text = header().read_text()
    except OSError as error:
        raise KernelUnavailable(
            f"the header of XLA's foreign function interface: {error}"
        ) from error
    found = [re.search(rf"#define XLA_FFI_API_{n} (\d+)", text) for n in ("MAJOR", "MINOR")]
    if None in found:
        raise KernelUnavailable(f"{header().name} states no version of XLA's interface")
    major, minor = (int(f[1]) for f in found if f)
    return major, minor


def unsupported() -> str | None:
    """Why the installed XLA cannot call the handlers, or None."""
    if ctypes.sizeof(c_void_p) != 8:
        return "handlers are written for 64-bit systems"
    try:
        major, minor = installed_version()
    except KernelUnavailable as error:
        return str(error)
    if major != MAJOR or minor < MINOR:
        return (
            f"XLA's foreign function interface has version {major}.{minor}; "
            f"handlers are written for {MAJOR}.{MINOR}"
        )
    return None


def register(name: str, address: int, platform: str) -> None:
    """Makes a handler known to XLA.

    Args:
      name: Name of the handler.
      address: Its machine code.
      platform: XLA's name of the platform, "cpu" or "CUDA".

    Raises:
      KernelUnavailable: If XLA refuses it: another version, or other structures.
    """
    # A refusal after the backend has been initialised concerns this handler, before it the backend.
    jax.local_devices(backend=platform.lower())
    try:
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform=platform)
    except Exception as error:  # XLA's own classes of errors differ between versions
        raise KernelUnavailable(f"XLA refused a kernel's handler: {error}") from error
