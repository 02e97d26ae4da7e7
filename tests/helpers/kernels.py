"""A small kernel with every kind of array, for tests of how kernels are run."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from codesign_jax.compiler import launch

LANES = 8


def body(rounds, x, table, out, scratch):
    """Logistic map x -> 3.9 x (1 - x), chaotic, kept in scratch memory, times a shared number."""
    scratch[0, :] = x[0, :]

    def again(k, c):
        now = scratch[0, :]
        scratch[0, :] = 3.9 * now * (1.0 - now)
        return c

    jax.lax.fori_loop(0, rounds, again, jnp.int32(0))
    out[0, :] = scratch[0, :] * table[0, :] + x[1, :]


def call(x, table, rounds=10):
    """The kernel as a `pallas_call`, with its outputs."""
    blocks = x.shape[0]
    dtype = x.dtype
    lanes = x.shape[2]

    def spec(rows, per_block=True):
        return pl.BlockSpec((None, rows, lanes), lambda i: (i if per_block else 0, 0, 0))

    outputs = [jax.ShapeDtypeStruct((blocks, rows, lanes), dtype) for rows in (1, 3)]
    function = pl.pallas_call(
        partial(body, rounds),
        grid=(blocks,),
        in_specs=[spec(2), spec(1, per_block=False)],
        out_specs=[spec(1), spec(3)],
        out_shape=outputs,
    )
    return function, outputs


def run(x, table, rounds=10, backend="cpu"):
    """Runs the kernel on x (block, 2, lane) and a shared table (1, 1, lane)."""
    function, outputs = call(x, table, rounds)
    kernel = launch.Kernel(f"logistic {rounds}", backend, x.shape[2], shared=(1,), scratch=(1,))
    result, none = launch.launch(function, (x, table), outputs, kernel)
    assert none is None
    return result


def expected(x, table, rounds=10):
    """The same by NumPy, rounded at other places."""
    now = np.asarray(x[:, :1])
    for _ in range(rounds):
        now = now.dtype.type(3.9) * now * (1 - now)
    return now * np.asarray(table) + np.asarray(x[:, 1:])


def numbers(blocks, dtype=np.float32, lanes=LANES):
    """Inputs of `run`, between 0 and 1."""
    rng = np.random.default_rng(blocks)
    return rng.random((blocks, 2, lanes)).astype(dtype), rng.random((1, 1, lanes)).astype(dtype)
