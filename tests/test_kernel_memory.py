"""Arrays of a kernel whose lanes each read and write elements of their own; slots of contacts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import pallas as pl

from codesign_jax.compiler.launch import Kernel, launch
from codesign_jax.engines.structured.kernel.memory import MemoryLayout
from codesign_jax.engines.structured.kernel.slots import Counts

LANES, ROWS, BLOCKS, LENGTH = 8, 5, 3, 40


def run(name, kernel, inputs, *outputs):
    """Runs a kernel on arrays (block, row, lane), and (1, element) that all blocks share."""
    shared = tuple(k for k, x in enumerate(inputs) if x.shape[0] == 1)

    def spec(shape):
        own = shape[0] == BLOCKS
        return pl.BlockSpec((None, *shape[1:]), lambda i: (i * own, *[0] * (len(shape) - 1)))

    call = pl.pallas_call(
        kernel,
        grid=(BLOCKS,),
        in_specs=[spec(x.shape) for x in inputs],
        out_specs=[spec(x.shape) for x in outputs],
        out_shape=list(outputs),
    )
    kind = Kernel(f"test {name} {[x.dtype for x in inputs]}", "cpu", LANES, shared)
    return jax.jit(lambda *x: launch(call, x, list(outputs), kind))(*inputs)


def lane():
    return jax.lax.broadcasted_iota(jnp.int32, (LANES,), 0)


@pytest.fixture(scope="module")
def numbers():
    rng = np.random.default_rng(0)
    return {
        "x": rng.standard_normal((BLOCKS, ROWS, LANES)),
        "table": rng.standard_normal((1, LENGTH)),
        "codes": rng.integers(-9, 9, (BLOCKS, ROWS, LANES)).astype(np.int32),
        "rows": rng.integers(0, ROWS, (BLOCKS, 3, LANES)).astype(np.int32),
        "places": rng.integers(0, LENGTH - 1, (BLOCKS, 2, LANES)).astype(np.int32),
    }


@pytest.mark.parametrize(
    ("computed", "stored"),
    [(np.float32, np.float32), (np.float64, np.float64), (np.float64, np.float32)],
)
def test_gather(numbers, computed, stored):
    """From a table that all blocks share, from rows, and of int32, at indices of int32 or computed.

    The table may have fewer bits than the numbers that the kernel computes with.
    """
    with jax.enable_x64(True):
        x = jnp.asarray(numbers["x"], computed)
        table = jnp.asarray(numbers["table"], stored)
        codes, rows, places = (jnp.asarray(numbers[k]) for k in ("codes", "rows", "places"))

        def kernel(x, table, codes, rows, places, out):
            at = places[0, :]
            out[0, :] = table[(at,)].astype(computed) + 2 * table[(at + 1,)].astype(computed)
            out[1, :] = x[rows[0, :], lane()]
            row = jnp.maximum(jnp.max(rows[0, :]).astype(jnp.int64), 3)  # the same on all lanes
            out[2, :] = x[row, (lane() * 3) & 7 | rows[0, :] & 0]  # columns, computed
            picked = codes[rows[1, :], lane()]
            out[3, :] = picked.astype(computed)
            # An index computed from floats, clamped by the kernel: nothing else checks it.
            far = (1e3 * x[0, :]).astype(jnp.int64)
            out[4, :] = x[jnp.minimum(jnp.maximum(far, 0), ROWS - 1), lane()]

        (got,) = run("gather", kernel, (x, table, codes, rows, places), x)
    x, table, codes, rows, places = (np.asarray(v) for v in (x, table, codes, rows, places))

    def pick(array, row):
        return np.take_along_axis(array, row[:, None], 1)[:, 0]

    at = places[:, 0]
    want = [
        table[0].astype(computed)[at] + 2 * table[0].astype(computed)[at + 1],
        pick(x, rows[:, 0]),
        x[np.arange(BLOCKS), np.maximum(rows[:, 0].max(1), 3)][:, np.arange(LANES) * 3 & 7],
        pick(codes, rows[:, 1]),
        pick(x, np.clip(np.trunc(1e3 * x[:, 0]).astype(int), 0, ROWS - 1)),
    ]
    # A product and a sum in one instruction round once.
    rtol = 4 * np.finfo(computed).eps
    np.testing.assert_allclose(got, np.stack(want, 1), rtol=rtol, atol=rtol)


# --- slots ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rows", "most"), [(11, 16), (3, 88), (41, 64), (1, 2**30), (2, 1)])
def test_counts_are_those_that_were_packed(rows, most):
    """In one integer and in many, up to the largest number, of all lanes and of some."""
    rng = np.random.default_rng(rows)
    counts = rng.integers(0, most + 1, (rows, 32)).astype(np.int32)
    counts[:, 0], counts[:, 1] = most, 0
    busy = rng.random(32) < 0.5
    packed = Counts.of_rows([jnp.asarray(c) for c in counts], most)
    for row, expected in enumerate(counts):
        np.testing.assert_array_equal(packed.of(row), expected)
        np.testing.assert_array_equal(packed.masked(busy).of(jnp.int32(row)), expected * busy)


def test_a_table_by_item_has_a_place_for_everything():
    """No two numbers share a row, no row is left over, and an item's numbers are neighbours."""
    groups = {"a": (3, (2,)), "set.b": (3, (1,)), "c": (2, ()), "d": (3, ()), "set.e": (3, (2, 2))}
    table, rows = MemoryLayout.by_item(True, **groups), {}
    for name, (count, shape) in groups.items():
        for item in range(count):
            first = table.offset[name] + item * table.stride[name]
            rows[name, item] = list(range(first, first + int(np.prod(shape))))
    assert sorted(sum(rows.values(), [])) == list(range(table.rows))
    for item in range(3):
        for names in (("a", "d"), ("set.b", "set.e")):
            own = sorted(sum((rows[name, item] for name in names), []))
            assert own == list(range(own[0], own[0] + len(own)))
