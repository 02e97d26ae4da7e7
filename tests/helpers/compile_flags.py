"""How XLA and kernels compile where programs run for milliseconds and compile for seconds."""

import os
from importlib import metadata

_ONE_THREAD = ("--xla_cpu_parallel_codegen_split_count=1",)
"""One thread compiles, as every core has a process of its own."""

_NO_EMITTERS = ("--xla_cpu_use_fusion_emitters=false",)
"""Without fusion emitters a step in plain JAX compiles in half of the time."""

_KNOWN = ("0.10.",)
"""Releases of jaxlib that know this flag: others end the process that has an unknown one."""

OPTIMIZED = (*_ONE_THREAD, *(_NO_EMITTERS if metadata.version("jaxlib").startswith(_KNOWN) else ()))

FLAGS = (
    *OPTIMIZED,
    # LLVM leaves the code as it is: an episode on MuJoCo C compiles in 2 s instead of 5. A sum may
    # be rounded otherwise than in a user's program, so tests of bits compare runs of one program.
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
)


def use(flags: tuple[str, ...] = FLAGS) -> None:
    """For this process, if it has not used JAX yet, and those that it starts.

    What the environment already has is left alone: XLA_FLAGS= CODESIGN_KERNEL_OPTIMIZATION=2
    compiles as for users.
    """
    if flags == FLAGS:
        os.environ.setdefault("CODESIGN_KERNEL_OPTIMIZATION", "0")
    os.environ.setdefault("XLA_FLAGS", " ".join(flags))
    # Every operation of a program would carry the lines of code from which it was called.
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
