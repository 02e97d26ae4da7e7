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
from typing import Any

import jax

MAJOR = 0
MINOR = 3
"""The version whose layout this module describes."""


class KernelUnavailable(RuntimeError):
    """Kernels cannot run here; the message says why."""


def _structure(name: str, *head: tuple[str, Any], **fields: Any) -> type[ctypes.Structure]:
    """A structure of XLA's; most begin with their size and a list of extensions."""
    head = head or (("struct_size", c_uint64), ("extension_start", c_void_p))
    return type(name, (ctypes.Structure,), {"_fields_": [*head, *fields.items()]})


_SIZE = ("struct_size", c_uint64)
Extension = _structure("XLA_FFI_Extension_Base", _SIZE, type=c_int32, next=c_void_p)
Version = _structure("XLA_FFI_Api_Version", major_version=c_int32, minor_version=c_int32)
# As far as it is written.
Metadata = _structure("XLA_FFI_Metadata", _SIZE, api_version=Version, traits=c_uint32)
MetadataExtension = _structure(
    "XLA_FFI_Metadata_Extension", ("extension_base", Extension), metadata=c_void_p
)
Buffer = _structure("XLA_FFI_Buffer", dtype=c_int32, data=c_void_p, rank=c_int64, dims=c_void_p)
Arguments = _structure("XLA_FFI_Args", size=c_int64, types=c_void_p, values=c_void_p)  # and _Rets
_ATTRIBUTES = dict(size=c_int64, types=c_void_p, names=c_void_p, attrs=c_void_p)
Attributes = _structure("XLA_FFI_Attrs", **_ATTRIBUTES)
_CALL = dict(api=c_void_p, ctx=c_void_p, stage=c_int32, args=Arguments, rets=Arguments)
# Without the future that a handler may set.
CallFrame = _structure("XLA_FFI_CallFrame", **_CALL, attrs=Attributes)
_FUNCTIONS = """internal_api error_create error_get_message error_destroy handler_register
stream_get type_register execution_context_get state_set state_get device_memory_allocate
device_memory_free thread_pool_schedule thread_pool_num_threads"""
# Up to the last function that handlers call.
Api = _structure("XLA_FFI_Api", api_version=Version, **dict.fromkeys(_FUNCTIONS.split(), c_void_p))
ErrorCreate = _structure("XLA_FFI_Error_Create_Args", message=c_void_p, errc=c_int32)
ErrorDestroy = _structure("XLA_FFI_Error_Destroy_Args", error=c_void_p)
StreamGet = _structure("XLA_FFI_Stream_Get_Args", ctx=c_void_p, stream=c_void_p)
Schedule = _structure(
    "XLA_FFI_ThreadPool_Schedule_Args", ctx=c_void_p, task=c_void_p, data=c_void_p
)
NumThreads = _structure(  # the number goes to an address
    "XLA_FFI_ThreadPool_NumThreads_Args", ctx=c_void_p, num_threads=c_void_p
)

METADATA = 1
"""XLA_FFI_Extension_Metadata: XLA asks a handler for the version that it was written for."""

INVALID_ARGUMENT = 3
RESOURCE_EXHAUSTED = 8
INTERNAL = 13
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
    return Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"


@functools.cache
def installed_version() -> tuple[int, int]:
    """Major and minor version of the installed jaxlib's interface."""
    try:
        text = header().read_text()
    except OSError as error:
        raise KernelUnavailable(
            f"the header of XLA's foreign function interface: {error}"
        ) from error
    matches = [re.search(rf"#define XLA_FFI_API_{n} (\d+)", text) for n in ("MAJOR", "MINOR")]
    if None in matches:
        raise KernelUnavailable(f"{header().name} states no version of XLA's interface")
    major, minor = (int(match[1]) for match in matches if match)
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
    """Makes a handler's machine code known to XLA, whose platforms are "cpu" and "CUDA"."""
    # A refusal after the backend has been initialised concerns this handler, before it the backend.
    jax.local_devices(backend=platform.lower())
    try:
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform=platform)
    except Exception as error:  # XLA's own classes of errors differ between versions
        raise KernelUnavailable(f"XLA refused a kernel's handler: {error}") from error
