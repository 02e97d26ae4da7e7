"""Runs a Pallas kernel, on a GPU through `thread` and `nvptx`, or on a CPU through `vector`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.compiler import thread


class Kernel(NamedTuple):
    """What a kernel is.

    Attributes:
      origin: What determines its code besides the package's own.
      backend: "gpu" or "cpu".
      lanes: Lanes of a block.
      shared: Places of inputs of one block that all blocks read; their leading axis is 1.
    """

    origin: str
    backend: str
    lanes: int
    shared: tuple[int, ...] = ()


def launch(
    call: Callable, inputs: tuple, outputs: list[jax.ShapeDtypeStruct], kernel: Kernel
) -> list[jax.Array]:
    """Returns call(*inputs), where call is a `pallas_call` over the leading axis of its arrays.

    Args:
      call: The kernel as a function of arrays whose leading axis is the grid's.
      inputs: Its arguments.
      outputs: Shapes of its results.
      kernel: What it is.
    """
    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in inputs]
    shapes = [tuple(x.shape[1:]) for x in (*avals, *outputs)]

    def trace() -> Any:
        # A block knows nothing of the devices that share the worlds, and traces sooner without.
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            return _pallas_call(jax.make_jaxpr(call)(*avals).jaxpr).params["jaxpr"]

    if kernel.backend == "cpu":
        from codesign_jax.compiler import native

        sizes = [x.dtype.itemsize for x in (*avals, *outputs)]
        layout = native.Layout(shapes, len(inputs), kernel.lanes, sizes[0], sizes)
        name = native.register(kernel.origin, trace, layout)
        return list(jax.ffi.ffi_call(name, outputs)(*inputs))
    from codesign_jax.compiler import nvptx

    jaxpr, number = trace(), np.int32
    blocks = [(shape, v.aval.dtype) for shape, v in zip(shapes, jaxpr.invars, strict=True)]
    text = thread.write(jaxpr, blocks, [k in kernel.shared for k in range(len(blocks))], "grasp")
    results = jax.ffi.ffi_call("__gpu$xla.gpu.ptx", outputs)(
        *inputs,
        name="grasp",
        kernel_type="ptx",
        kernel_data=nvptx.assembly(text),
        grid_x=number(outputs[0].shape[0]),
        grid_y=number(1),
        grid_z=number(1),
        block_x=number(thread.LANES),
        block_y=number(1),
        block_z=number(1),
        shared_mem_bytes=number(0),
        output_indices=tuple(range(len(inputs), len(shapes))),
    )
    return list(results)


def _pallas_call(jaxpr: Any) -> Any:
    """The kernel's equation, wherever it is nested."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "pallas_call":
            return equation
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                found = _pallas_call(inner)
                if found is not None:
                    return found
    return None
