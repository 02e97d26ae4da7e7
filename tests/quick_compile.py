"""How XLA compiles where programs run for milliseconds and compile for seconds."""

import os

# Without optimising and without fusion emitters a step of the batch form compiles in 5 s instead
# of 17 and runs half as fast; one thread compiles, as every core has a process of its own.
FLAGS = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
)


def use() -> None:
    """For this process, if it has not used JAX yet, and those that it starts.

    Flags that the environment already has are left alone: XLA_FLAGS= compiles as for users.
    """
    os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))
