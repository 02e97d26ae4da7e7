"""Runs a Pallas kernel on a CPU: machine code by LLVM, called by XLA.  Imported where it is used.

XLA calls the code through its foreign function interface, of which only the memory layout is
needed (c_api.h in `jax.ffi.include_dir`).  Machine code is kept beside JAX's compilation cache.
"""

import contextlib
import ctypes
import functools
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import llvmlite
import llvmlite.binding as binding
import numpy as np

import codesign_jax
from codesign_jax.compiler import vector

# Offsets in bytes in the structures of XLA's foreign function interface, 64 bit.
_EXTENSION, _ARGS, _RETS = 8, 72, 112  # in XLA_FFI_CallFrame
_TYPE, _METADATA = 8, 24  # in XLA_FFI_Metadata_Extension
_MAJOR, _MINOR = 24, 28  # in XLA_FFI_Metadata
_DATA, _DIMS = 24, 40  # in XLA_FFI_Buffer

_loaded: dict[str, Any] = {}  # engines own the machine code and must live as long as JAX


class Layout(NamedTuple):
    """The arrays of a kernel.

    Attributes:
      shapes: Shape of a block of each.
      inputs: How many of them, the first ones, are inputs.
      lanes: Lanes of a block.
      itemsize: Bytes of a computed float.
      bytes: Bytes of an element of each array.
    """

    shapes: list[tuple[int, ...]]
    inputs: int
    lanes: int
    itemsize: int
    bytes: list[int]


@functools.cache
def vector_bytes() -> int:
    """Size of this CPU's vector registers."""
    features = binding.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


@functools.cache
def _api_version() -> tuple[int, int]:
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text()

    def number(name: str) -> int:
        found = re.search(rf"#define {name} (\d+)", text)
        assert found is not None, f"{header} has no {name}"
        return int(found[1])

    return number("XLA_FFI_API_MAJOR"), number("XLA_FFI_API_MINOR")


def _handler(name: str, layout: Layout) -> str:
    """The function that XLA calls; it runs the blocks one after another.

    An array of one block belongs to all of them.
    """
    major, minor = _api_version()
    arrays = zip(layout.bytes, layout.shapes, strict=True)
    sizes = [size * int(np.prod(shape)) for size, shape in arrays]
    lines = [
        f"define ptr @{name}(ptr %frame) nounwind {{",
        "entry:",
        f"%at = getelementptr i8, ptr %frame, i64 {_EXTENSION}",
        "%extension = load ptr, ptr %at",
        "%plain = icmp eq ptr %extension, null",
        "br i1 %plain, label %run, label %ask",
        # Asked for the version of the interface before the first call.
        "ask:",
        f"%type.at = getelementptr i8, ptr %extension, i64 {_TYPE}",
        "%type = load i32, ptr %type.at",
        "%metadata = icmp eq i32 %type, 1",
        "br i1 %metadata, label %answer, label %run",
        "answer:",
        f"%meta.at = getelementptr i8, ptr %extension, i64 {_METADATA}",
        "%meta = load ptr, ptr %meta.at",
        f"%major = getelementptr i8, ptr %meta, i64 {_MAJOR}",
        f"store i32 {major}, ptr %major",
        f"%minor = getelementptr i8, ptr %meta, i64 {_MINOR}",
        f"store i32 {minor}, ptr %minor",
        "ret ptr null",
        "run:",
    ]
    for which, offset in (("args", _ARGS), ("rets", _RETS)):
        lines += [
            f"%{which}.at = getelementptr i8, ptr %frame, i64 {offset}",
            f"%{which} = load ptr, ptr %{which}.at",
        ]
    for k in range(len(sizes)):
        which, place = ("args", k) if k < layout.inputs else ("rets", k - layout.inputs)
        lines += [
            f"%p{k} = getelementptr ptr, ptr %{which}, i64 {place}",
            f"%b{k} = load ptr, ptr %p{k}",
            f"%d{k}.at = getelementptr i8, ptr %b{k}, i64 {_DATA}",
            f"%d{k} = load ptr, ptr %d{k}.at",
            f"%n{k}.at = getelementptr i8, ptr %b{k}, i64 {_DIMS}",
            f"%n{k}.p = load ptr, ptr %n{k}.at",
            f"%n{k} = load i64, ptr %n{k}.p",
            f"%one{k} = icmp eq i64 %n{k}, 1",
            f"%s{k} = select i1 %one{k}, i64 0, i64 {sizes[k]}",
        ]
    lines += [
        "br label %loop",
        "loop:",
        "%i = phi i64 [ 0, %run ], [ %next, %body ]",
        "%more = icmp slt i64 %i, %n0",
        "br i1 %more, label %body, label %done",
        "body:",
    ]
    for k in range(len(sizes)):
        lines += [
            f"%o{k} = mul i64 %i, %s{k}",
            f"%c{k} = getelementptr i8, ptr %d{k}, i64 %o{k}",
        ]
    arguments = ", ".join(f"ptr %c{k}" for k in range(len(sizes)))
    lines += [
        f"call void @block({arguments})",
        "%next = add i64 %i, 1",
        "br label %loop",
        "done:",
        "ret ptr null",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _machine() -> Any:
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=2,
        jit=True,
    )


def _compile(text: str, machine: Any) -> bytes:
    """Object file of a program in LLVM's language."""
    module = binding.parse_assembly(text)
    module.triple = machine.triple
    options = binding.create_pipeline_tuning_options(speed_level=2)
    # Everything is in vectors already, and loops over links are to stay loops.
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = False
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


@functools.cache
def _sources() -> str:
    """Digest of this package's code: what is kept belongs to the code that made it."""
    digest = hashlib.sha256()
    for path in sorted(Path(codesign_jax.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _name(kernel: str) -> str:
    """Name of the machine code of a kernel on this CPU, of this code and these versions."""
    made_by = (
        jax.__version__,
        llvmlite.__version__,
        _api_version(),
        binding.get_host_cpu_name(),
        binding.get_host_cpu_features().flatten(),
    )
    return "grasp_" + hashlib.sha256(repr((kernel, _sources(), made_by)).encode()).hexdigest()


def _kept(name: str, build: Callable[[], bytes]) -> bytes:
    """Machine code from JAX's cache, if there is one, or built and put there."""
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if folder is None:
        return build()
    path = Path(folder) / f"{name}.o"
    if path.exists():
        return path.read_bytes()
    code = build()
    # A cache that cannot be written is no reason to stop.
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(code)
        os.replace(part, path)
    return code


def register(origin: str, trace: Callable[[], Any], layout: Layout) -> str:
    """Compiles a kernel and makes it known to XLA; returns the name to call it by.

    Args:
      origin: What determines the kernel besides the package's code and the layout; one that was
        compiled before is not traced again.
      trace: Returns the kernel's jaxpr; its arguments are references to a block of each array.
      layout: Its arrays.
    """
    name = _name(repr((origin, layout)))
    if name in _loaded:
        return name
    machine = _machine()

    def build() -> bytes:
        jaxpr = trace()
        types = [v.aval.dtype for v in jaxpr.invars]
        code = vector.write(jaxpr, list(zip(layout.shapes, types, strict=True)), layout.lanes)
        return _compile(code + _handler(name, layout), machine)

    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(_kept(name, build)))
    engine.finalize_object()
    function = ctypes.CFUNCTYPE(ctypes.c_void_p)(engine.get_function_address(name))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform="cpu")
    _loaded[name] = engine
    return name
