"""Kernels on NVIDIA GPUs: device code in PTX, launched by a handler in host machine code.

A thread has LLVM write the PTX and the driver translate it, into a library of its own, which
belongs to no context: one handle serves every GPU of the host.  The driver keeps its translation on
disk itself (CUDA_CACHE_PATH).  The handler asks XLA for the stream and calls `cuLaunchKernel` on
it, one block of a warp for each block of the arrays.  Python and its lock take no part.

A kernel's entry point has one pointer an array, in the layout's order, to the array's first block,
and finds its own blocks (block index times size, or the first one where an array is shared).

Sources: CUDA Driver API (library management, execution control); `ffi` for XLA's side.
"""

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import jax

from codesign_jax import reuse
from codesign_jax.compiler import ffi, handlers, thread
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.compiler.handlers import Handler
from codesign_jax.compiler.values import ONCHIP, Layout

ENTRY = "kernel"
"""Name of the device code's entry point."""

CALLS = (
    "cuStreamGetCtx",
    "cuCtxPushCurrent_v2",
    "cuLaunchKernel",
    "cuCtxPopCurrent_v2",
    "cuGetErrorName",
)
"""Functions of the driver that a handler calls, in the order of its table of addresses."""

_OLDEST_DRIVER = 12_000  # cuLibraryLoadData and launches by CUkernel
# CU_JIT_ERROR_LOG_BUFFER and its size [bytes]
_LOG_BUFFER = 5
_LOG_SIZE = 6
_LOG_BYTES = 4096
_MESSAGE_BYTES = 512

_lent: list[Any] = []  # memory that the driver may write to whenever it translates for another GPU


def block_code(jaxpr: Any, layout: Layout) -> str:
    """A kernel with the entry point `ENTRY` in LLVM's language, of which PTX is made."""
    return thread.write(jaxpr, layout, ENTRY)


class Driver:
    """NVIDIA's driver, whose errors become exceptions."""

    def __init__(self, library: Any):
        self.library = library

    def __call__(self, function: str, *args: Any) -> None:
        result = getattr(self.library, function)(*args)
        if result:
            text = ctypes.c_char_p()
            self.library.cuGetErrorName(result, ctypes.byref(text))
            raise KernelUnavailable(f"{function}: {(text.value or b'').decode()} ({result})")

    def address(self, function: str) -> int:
        pointer = ctypes.cast(getattr(self.library, function), ctypes.c_void_p).value
        assert pointer
        return pointer


@functools.cache
def driver() -> Driver:
    """The driver of this computer, initialised."""
    try:
        opened = Driver(ctypes.CDLL("libcuda.so.1"))
    except OSError as error:
        raise KernelUnavailable(f"NVIDIA's driver cannot be loaded: {error}") from error
    opened("cuInit", 0)
    version = ctypes.c_int()
    opened("cuDriverGetVersion", ctypes.byref(version))
    if version.value < _OLDEST_DRIVER:
        raise KernelUnavailable(
            f"NVIDIA's driver supports CUDA {version.value // 1000}.{version.value % 1000 // 10}; "
            f"kernels need {_OLDEST_DRIVER // 1000}.0"
        )
    return opened


def load(driver: Driver, text: str, device: int) -> int:
    """Hands PTX to the driver for the rest of the process; returns the kernel's handle.

    The driver translates it for one GPU now, where an error can be told, with its assembler's
    message, and for others at their first launch.
    """
    library = ctypes.c_void_p()
    kernel = ctypes.c_void_p()
    log = ctypes.create_string_buffer(_LOG_BYTES)
    options = (ctypes.c_int * 2)(_LOG_BUFFER, _LOG_SIZE)
    values = (ctypes.c_void_p * 2)(ctypes.addressof(log), _LOG_BYTES)
    code = ctypes.create_string_buffer(text.encode())
    _lent.append((log, options, values))
    try:
        none = ctypes.c_uint(0)
        driver(
            "cuLibraryLoadData",
            *(ctypes.byref(library), code, options, values, ctypes.c_uint(2)),
            *(None, None, none),
        )
        driver("cuLibraryGetKernel", ctypes.byref(kernel), library, ENTRY.encode())
        _translate(driver, kernel, device)
    except KernelUnavailable as error:
        raise KernelUnavailable(f"{error} {log.value.decode(errors='replace')}".strip()) from error
    assert kernel.value
    return kernel.value


def _translate(driver: Driver, kernel: ctypes.c_void_p, device: int) -> None:
    context = ctypes.c_void_p()
    function = ctypes.c_void_p()
    driver("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)
    try:
        driver("cuCtxPushCurrent_v2", context)
        try:
            driver("cuKernelGetFunction", ctypes.byref(function), kernel)
        finally:
            driver("cuCtxPopCurrent_v2", ctypes.byref(context))
    finally:
        driver("cuDevicePrimaryCtxRelease_v2", device)


def prepare(name: str, layout: Layout, driver: Driver, *, keep: bool = True) -> handlers.Loaded:
    """The handler of a kernel, compiled and told the driver's functions."""
    loaded = handlers.prepare(handler_code(name, layout), keep=keep)
    table = loaded.numbers(f"{name}_table", len(CALLS))
    for k, function in enumerate(CALLS):
        table[k] = driver.address(function)
    return loaded


def register(origin: str, trace: Callable[[], Any], layout: Layout, *, keep: bool = True) -> str:
    """As `cpu.register`."""
    name = "kernel_" + reuse.digest("cuda", origin, layout, *handlers.identity()[:2])
    with handlers.LOCK:
        if not handlers.known(name):
            file = reuse.Kept(reuse.kernel_file(name) if keep else None)
            kept = file.read()
            text = "" if kept else block_code(trace(), layout)
            device = jax.local_devices(backend="cuda")[0].local_hardware_id or 0
            loaded = prepare(name, layout, driver(), keep=keep)
            handlers.register(name, loaded, "CUDA")

            def translated() -> int:
                ptx = kept or file.write(thread.assembly(text).encode())
                return load(driver(), ptx.decode(), device)

            handlers.supply(name, loaded, translated)
    return name


_DECLARATIONS = "declare i32 @snprintf(ptr, i64, ptr, ...)\n"


def handler_code(name: str, layout: Layout) -> str:
    """The handler of a kernel, with a table of the driver's functions."""
    h = Handler(name, layout)
    h.globals.append(f"@{name}_table = global [{len(CALLS)} x ptr] zeroinitializer\n")
    c = h.code
    blocks = h.blocks
    places = [k for k, array in enumerate(layout.arrays) if array.role != ONCHIP]
    with c.when(c.let(f"icmp eq i64 {blocks}, 0")):
        c.end("ret ptr null")
    with c.when(c.let(f"icmp sgt i64 {blocks}, {2**31 - 1}")):
        h.fail(ffi.INVALID_ARGUMENT, h.message(f"kernel {name}: more blocks than a grid has"))
    kernel = h.kernel()
    stream = _stream(h)
    addresses = c.local("ptr", len(places))
    params = c.local("ptr", len(places))
    for k, array in enumerate(places):
        place = c.byte(addresses, 8 * k)
        c.do(f"store ptr {h.data[array]}, ptr {place}")
        c.do(f"store ptr {place}, ptr {c.byte(params, 8 * k)}")
    context = c.local("ptr")
    got = _call(h, "cuStreamGetCtx", f"ptr {stream}, ptr {context}")
    _check(h, "cuStreamGetCtx", got)
    pushed = _call(h, "cuCtxPushCurrent_v2", f"ptr {c.let(f'load ptr, ptr {context}')}")
    _check(h, "cuCtxPushCurrent", pushed)
    grid = c.let(f"trunc i64 {blocks} to i32")
    launched = _call(
        h,
        "cuLaunchKernel",
        f"ptr {kernel}, i32 {grid}, i32 1, i32 1, i32 {h.layout.lanes}, i32 1, i32 1, i32 0, "
        f"ptr {stream}, ptr {params}, ptr null",
    )
    popped = _call(h, "cuCtxPopCurrent_v2", f"ptr {context}")
    _check(h, "cuLaunchKernel", launched)
    _check(h, "cuCtxPopCurrent", popped)
    c.end("ret ptr null")
    return _DECLARATIONS + h.text()


def _stream(h: Handler) -> str:
    c = h.code
    record = c.record(ffi.StreamGet, ctx=h.ctx)
    error = h.call("stream_get", record)
    with c.when(c.let(f"icmp ne ptr {error}, null")):
        c.end(f"ret ptr {error}")
    return c.get(record, ffi.StreamGet, "stream")


def _call(h: Handler, function: str, arguments: str) -> str:
    place = h.code.byte(f"@{h.name}_table", 8 * CALLS.index(function))
    pointer = h.code.let(f"load ptr, ptr {place}")
    return h.code.let(f"call i32 {pointer}({arguments})")


def _check(h: Handler, function: str, result: str) -> None:
    """Returns an error that names function and result, unless the result is CUDA_SUCCESS."""
    c = h.code
    with c.when(c.let(f"icmp ne i32 {result}, 0")):
        known = c.local("ptr")
        text = c.local("i8", _MESSAGE_BYTES)
        c.do(f"store ptr {h.message('unknown error')}, ptr {known}")
        _call(h, "cuGetErrorName", f"i32 {result}, ptr {known}")
        form = h.message(f"kernel {h.name}: {function}: %s (%d)")
        c.let(
            f"call i32 (ptr, i64, ptr, ...) @snprintf(ptr {text}, i64 {_MESSAGE_BYTES}, "
            f"ptr {form}, ptr {c.let(f'load ptr, ptr {known}')}, i32 {result})"
        )
        h.fail(ffi.INTERNAL, text)
