"""Machine code of this computer's processor, made and loaded by LLVM.  Needs llvmlite.

The environment variable CODESIGN_KERNEL_OPTIMIZATION says how much LLVM optimises: 2, the default,
or 0, which takes half of LLVM's time, for programs that run for milliseconds.  A kernel may ask for
less than the default, see `launch.Kernel`.
"""

import ctypes
import functools
import os
import threading
from typing import Any

import llvmlite
import llvmlite.binding as binding

from codesign_jax.compiler import ffi, handler

OPTIMIZATION = "CODESIGN_KERNEL_OPTIMIZATION"
LOCK = threading.RLock()
"""Held while a kernel is compiled and registered."""

_loaded: dict[str, "Loaded"] = {}


@functools.cache
def vector_bytes() -> int:
    """Size of this processor's vector registers."""
    features = binding.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


def identity() -> tuple[object, ...]:
    """What machine code of this processor depends on besides its source.

    The first two, LLVM's level of optimisation and version, are what a GPU's code depends on.
    """
    return (
        _level(),
        llvmlite.__version__,
        binding.get_default_triple(),
        binding.get_host_cpu_name(),
        binding.get_host_cpu_features().flatten(),
    )


def _level() -> int:
    """LLVM's level of optimisation.

    Raises:
      ValueError: If the environment states one that is neither 0 nor 2.
    """
    text = os.environ.get(OPTIMIZATION, "2")
    if text not in ("0", "2"):
        raise ValueError(f"{OPTIMIZATION} = {text!r} must be 0 or 2")
    return int(text)


def _machine(level: int = 2) -> Any:
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=level,
        jit=True,
    )


def compile(text: str, level: int = 2) -> bytes:
    """Object file of a program in LLVM's language.

    Args:
      text: The program.
      level: Level at which machine code is chosen, 1 or 2, and the highest of other passes.
    """
    # Where the environment says 0, machine code is still chosen at this level. At 0 that would take
    # a fourth of the time, but multiplications and additions are fused here and not there, and the
    # bits of a world then depend on its neighbours.
    machine = _machine(level)
    module = binding.parse_assembly(text)
    module.triple = machine.triple
    options = binding.create_pipeline_tuning_options(speed_level=min(level, _level()))
    # Everything is in vectors already, and loops over links are to stay loops.
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = False
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


class Loaded:
    """An object file in memory, for the rest of the process."""

    def __init__(self, code: bytes):
        """Loads it; functions of the C library are found by their names."""
        engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
        engine.add_object_file(binding.ObjectFileRef.from_data(code))
        engine.finalize_object()
        self.engine = engine
        # Threads of XLA may still be in the code when the interpreter ends: it is never freed.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(engine))

    def function(self, name: str) -> int:
        """Address of a function."""
        return self.engine.get_function_address(name)

    def numbers(self, name: str, count: int) -> Any:
        """A global variable of 64-bit numbers, to read and to write."""
        return (ctypes.c_uint64 * count).from_address(self.engine.get_global_value_address(name))


def known(name: str) -> bool:
    """Whether a handler of this name has been registered."""
    return name in _loaded


def register(name: str, loaded: Loaded, platform: str) -> None:
    """Makes a loaded handler known to XLA.

    Raises:
      KernelUnavailable: If XLA has another version, or its structures are smaller.
    """
    try:
        ffi.register(name, loaded.function(name), platform)
    except ffi.KernelUnavailable as error:
        sizes = loaded.numbers(handler.seen(name), len(handler.SEEN))
        structures = (ffi.CallFrame, ffi.Api, ffi.Metadata)
        for what, size, structure in zip(handler.SEEN, sizes, structures, strict=True):
            if size and size < ffi.size(structure):
                raise ffi.KernelUnavailable(
                    f"XLA's {what} has {size} bytes; handlers are written for {ffi.size(structure)}"
                ) from error
        raise
    _loaded[name] = loaded
