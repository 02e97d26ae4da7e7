"""The one way to run a Pallas kernel: on a CPU through `cpu`, on an NVIDIA GPU through `gpu`."""

import contextlib
import functools
import gc
import importlib.metadata
import uuid
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax import reuse
from codesign_jax.compiler import ffi
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.compiler.values import INPUT, ONCHIP, OUTPUT, SCRATCH, Array, Layout

OLDEST_LLVMLITE = (0, 45)
OLDEST_GPU = (8, 0)
"""Oldest compute capability that device code is written for (sm_80)."""


class Kernel(NamedTuple):
    """What a kernel is."""

    # Cache key, beyond the source of the compiler and the types and shapes of the blocks. Kernels
    # of one origin and layout, written by one state of this package's code (`reuse`), are taken to
    # be the same.
    origin: str
    backend: str  # "gpu" or "cpu"
    lanes: int  # Lanes of a block, see `block_lanes`
    # Places of inputs of one block that all blocks read; their leading axis is 1
    shared: tuple[int, ...] = ()
    # Places among the outputs of scratch memory. Scratch does not outlive a block, so one buffer a
    # thread suffices on a CPU; on a GPU every block has its own.
    scratch: tuple[int, ...] = ()
    # Places of further scratch memory that a GPU has in shared memory, if it is small enough
    onchip: tuple[int, ...] = ()
    # Places of outputs where lanes read what other lanes write, see `Array`
    exchanged: tuple[int, ...] = ()
    level: int = 2  # LLVM's level of optimisation on a CPU, 1 or 2


SHARED_BYTES = 27_648
"""Shared memory of a block of which eight, all that registers allow, share 228 kB (sm_90)."""


@functools.cache
def available(platform: str) -> str | None:
    """Why kernels cannot run on a platform of JAX's, or None; "gpu" is only NVIDIA's."""
    if platform not in ("cpu", "gpu"):
        return f"kernels are compiled for CPUs and NVIDIA GPUs, not for {platform!r}"
    return _llvmlite() or ffi.unsupported() or (_gpu() if platform == "gpu" else None)


WARPS_EACH = 4
"""Warps of a GPU's multiprocessor up to which narrower blocks are faster: one a scheduler."""
FEWEST_LANES = 8


def block_lanes(platform: str, dtype: Any, total: int | None = None) -> int:
    """Lanes that fill a vector of the CPU, or a warp.

    A block takes as long as its slowest world.  Where a batch leaves a GPU's schedulers without
    work, blocks are half or a quarter of a warp, so that fewer worlds wait for one another
    (whole grasps of 1,728 worlds on an H200, half a warp and a whole one: 0.72 and 0.41 million
    world-steps/s with the hull and contact between fingers, 2.9 and 2.2 with the hull; of 7,200
    worlds, where whole warps are kept, 1.15 and 1.04, 3.9 and 4.5; without contact with the palm).

    Args:
      platform: As `jax.default_backend` names it.
      dtype: Type of the numbers.
      total: Lanes of all worlds of the batch, if they are known.
    """
    if platform == "cpu":
        from codesign_jax.compiler import handlers

        return handlers.vector_bytes() // np.dtype(dtype).itemsize
    lanes = 32
    if total is not None:
        while lanes > FEWEST_LANES and 2 * total <= lanes * WARPS_EACH * multiprocessors():
            lanes //= 2
    return lanes


@functools.cache
def multiprocessors() -> int:
    """Multiprocessors of this computer's first GPU; those of an A100 if it cannot be asked."""
    try:
        return int(getattr(jax.local_devices(backend="gpu")[0], "core_count", 108))
    except RuntimeError:  # the kernel is compiled for another computer
        return 108


def launch(
    call: Callable, inputs: tuple, outputs: list[jax.ShapeDtypeStruct], kernel: Kernel
) -> list[jax.Array | None]:
    """Returns call(*inputs), where call is a `pallas_call` over the leading axis of its arrays.

    The kernel is traced and compiled once for a layout, whatever the number of blocks.

    Args:
      call: The kernel as a function of arrays whose leading axis is the grid's.
      inputs: Its arguments.
      outputs: Shapes of its results.
      kernel: What it is.

    Returns:
      The results, None in the place of scratch memory.

    Raises:
      KernelUnavailable: If kernels cannot run here, or no longer, see `reuse`.
      NotImplementedError: If the kernel does something that the compiler has no instruction for.
      ValueError: If an array's leading axis is not that of the others.
    """
    if reason := available(kernel.backend) or reuse.memory_problem():
        raise KernelUnavailable(reason)
    if kernel.backend == "cpu":
        from codesign_jax.compiler import cpu

        register = functools.partial(cpu.register, level=kernel.level)
    else:
        from codesign_jax.compiler import gpu

        register = gpu.register
    layout = describe(inputs, outputs, kernel)
    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in inputs]

    def trace() -> Any:
        return kernel_jaxpr(call, avals)

    # Of code that is not known no kernel is found again, neither on disk nor in this process.
    key = reuse.key(kernel.origin)
    origin = key or str(uuid.uuid4())
    with _no_collection():
        name = register(origin, trace, layout, keep=key is not None)
    computed = [k for k, a in enumerate(layout.arrays[len(inputs) :]) if a.role == OUTPUT]
    varying = _varying(inputs)
    shapes = [jax.ShapeDtypeStruct(outputs[k].shape, outputs[k].dtype, **varying) for k in computed]
    results: list[jax.Array | None] = [None] * len(outputs)
    for k, result in zip(computed, jax.ffi.ffi_call(name, shapes)(*inputs), strict=True):
        results[k] = None if k in (*kernel.scratch, *kernel.onchip) else result
    return results


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Without Python's search for garbage: of the millions of objects of a trace few are garbage.

    The searches would be a tenth of the time that a kernel takes to compile.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def describe(inputs: Any, outputs: Any, kernel: Kernel) -> Layout:
    """The layout of a kernel's arrays; scratch memory on a GPU is an output that nobody reads."""
    arrays = []
    scratch = SCRATCH if kernel.backend == "cpu" else OUTPUT
    blocks = outputs[0].shape[0]
    for k, x in enumerate((*inputs, *outputs)):
        place = k - len(inputs)
        unread = place in (*kernel.scratch, *kernel.onchip)
        role = INPUT if place < 0 else scratch if unread else OUTPUT
        size = np.prod(x.shape[1:]) * np.dtype(x.dtype).itemsize
        if place in kernel.onchip and kernel.backend == "gpu" and size <= SHARED_BYTES:
            role = ONCHIP
        shared = k in kernel.shared
        if x.shape[0] != (1 if shared else blocks):
            requirement = (
                "is shared and must have one block" if shared else f"must have {blocks} blocks"
            )
            raise ValueError(f"array {k} of shape {x.shape} {requirement}")
        if shared and role != INPUT:
            raise ValueError(f"array {k} is an output; only inputs can be shared")
        name = np.dtype(x.dtype).name
        exchanged = place in kernel.exchanged
        arrays.append(Array(tuple(x.shape[1:]), name, role, shared, exchanged))
    return Layout(tuple(arrays), kernel.lanes)


def kernel_jaxpr(call: Callable, avals: list) -> Any:
    """The jaxpr of a `pallas_call`'s kernel; its arguments are references to a block each."""
    # The kernel of a block does not depend on how devices share the worlds (shard_map); tracing it
    # without that information is faster.
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        return _pallas_call(jax.make_jaxpr(call)(*avals).jaxpr).params["jaxpr"]


def _varying(inputs: tuple) -> dict[str, Any]:
    """In `jax.shard_map`, the axes along which results differ: those of any input."""
    every = frozenset().union(*(jax.typeof(x).manual_axis_type.varying for x in inputs))
    if not every:
        return {}
    mesh = jax.sharding.get_abstract_mesh()
    whole = jax.sharding.PartitionSpec()
    return {
        "sharding": jax.sharding.NamedSharding(mesh, whole),
        "manual_axis_type": jax.sharding.ManualAxisType(varying=every),
    }


def _llvmlite() -> str | None:
    try:
        version = importlib.metadata.version("llvmlite")
        import llvmlite.binding  # noqa: F401  # its own library may not load
    except (ImportError, OSError) as error:
        return f"llvmlite, which compiles kernels, cannot be imported: {error}"
    if tuple(int(n) for n in version.split(".")[:2]) < OLDEST_LLVMLITE:
        return f"llvmlite {version} is older than {'.'.join(map(str, OLDEST_LLVMLITE))}"
    return None


def _gpu() -> str | None:
    from codesign_jax.compiler import gpu

    try:
        devices = jax.local_devices(backend="gpu")
    except RuntimeError as error:
        return f"no GPU: {error}"
    for device in devices:
        capability = str(getattr(device, "compute_capability", ""))
        major, _, minor = capability.partition(".")
        if not (major.isdecimal() and minor.isdecimal()):
            return f"{device.device_kind} is no NVIDIA GPU"
        if (int(major), int(minor)) < OLDEST_GPU:
            oldest = ".".join(map(str, OLDEST_GPU))
            return (
                f"{device.device_kind} has compute capability {capability}, kernels need {oldest}"
            )
    try:
        gpu.driver()
    except KernelUnavailable as error:
        return str(error)
    return None


def _pallas_call(jaxpr: Any) -> Any:
    for equation in jaxpr.eqns:
        if equation.primitive.name == "pallas_call":
            return equation
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                call = _pallas_call(inner)
                if call is not None:
                    return call
    return None
