"""How XLA compiles where programs run for milliseconds and compile for seconds."""

import os
from importlib import metadata

# Without fusion emitters a step in plain JAX compiles in 8 s instead of 17 and runs as fast;
# one thread compiles, as every core has a process of its own. With an optimisation level of 0 as
# well it would be 5 s, but then a scan over episodes has other bits than single episodes.
FLAGS = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
)


KNOWN = ("0.10.",)
"""Releases of jaxlib that know both flags: others end the process that has an unknown one."""


def use() -> None:
    """For this process, if it has not used JAX yet, and those that it starts.

    Flags that the environment already has are left alone: XLA_FLAGS= compiles as for users.
    """
    if metadata.version("jaxlib").startswith(KNOWN):
        os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))
