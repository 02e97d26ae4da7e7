"""Arrays of a kernel whose lanes each read and write elements of their own; slots of contacts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import pallas as pl

from codesign_jax import scene
from codesign_jax.compiler.launch import Kernel, launch
from codesign_jax.engines.structured.kernel.counts import Counts
from codesign_jax.engines.structured.kernel.memory import MemoryLayout
from codesign_jax.engines.structured.kernel.tables import Tables

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


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_scatter(numbers, dtype):
    """Lanes append to columns of their own, as many entries as each of them has."""
    source = numbers["x" if dtype == np.float32 else "codes"].astype(dtype)
    floats = numbers["x"].astype(np.float32)

    def kernel(floats, source, out, count):
        zero = jnp.zeros((LANES,), dtype)
        for k in range(ROWS + 1):
            out[k, :] = zero

        def append(k, used):
            wanted = source[k, :] > 0
            # What is not wanted goes to the row below the others.
            out[jnp.where(wanted, used, ROWS), lane()] = source[k, :]
            return used + wanted.astype(jnp.int32)

        used = jax.lax.fori_loop(0, ROWS, append, jnp.zeros((LANES,), jnp.int32))
        count[0, :] = used

    shapes = [
        jax.ShapeDtypeStruct((BLOCKS, ROWS + 1, LANES), dtype),
        jax.ShapeDtypeStruct((BLOCKS, 1, LANES), np.int32),
    ]
    got, count = run("scatter", kernel, (floats, source), *shapes)
    np.testing.assert_array_equal(count[:, 0], (source > 0).sum(1))
    for block in range(BLOCKS):
        for column in range(LANES):
            kept = [v for v in source[block, :, column] if v > 0]
            want = kept + [0] * (ROWS - len(kept))
            np.testing.assert_array_equal(got[block, :ROWS, column], want)


def test_lanes_of_one_world_store_in_one_place(numbers):
    """As those of a hand whose fingers fill the block: all lanes have the same number."""
    x = np.repeat(numbers["x"][..., :1], LANES, 2).astype(np.float32)

    def kernel(x, out):
        world = jax.lax.rem(lane(), jnp.int32(1))
        out[0, world] = x[0, :]
        out[1, world] = 2 * out[0, world] + x[1, :]

    (got,) = run("one world", kernel, (x,), jax.ShapeDtypeStruct((BLOCKS, 2, 1), np.float32))
    np.testing.assert_array_equal(got[:, 0, 0], x[:, 0, 0])
    # A product and a sum in one instruction round once.
    np.testing.assert_allclose(got[:, 1, 0], 2 * x[:, 0, 0] + x[:, 1, 0], rtol=1e-6)


def test_what_memory_cannot_do_is_named(numbers):
    """A vector for each lane, and elements that are neither floats nor int32."""
    x, rows = numbers["x"].astype(np.float32), numbers["rows"]

    def slices(x, rows, out):
        out[0, :] = x[rows[0, :], :][0]

    with pytest.raises(NotImplementedError, match="one number of each lane"):
        run("slices", slices, (x, rows), jax.ShapeDtypeStruct(x.shape, np.float32))

    def small(x, rows, out):
        out[0, :] = x[0, :] + rows[0, :].astype(jnp.float32)

    with pytest.raises(NotImplementedError, match="no dtype int8"):
        inputs = (x, rows.astype(np.int8))
        run("small", small, inputs, jax.ShapeDtypeStruct(x.shape, np.float32))


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


def test_only_gpus_have_an_item_for_lanes_without_a_contact():
    """Lanes of a CPU's vector read a slot's item together, whether they have filled it or not."""
    here = {
        name: {s.name: s for s in Tables(scene.load("paper"), backend=name, width=32).sets}
        for name in ("cpu", "gpu")
    }
    cpu, gpu = (here[backend]["finger_finger"] for backend in ("cpu", "gpu"))
    assert not cpu.gathers
    assert gpu.gathers
    assert gpu.count == cpu.count + 1 == cpu.rows * (cpu.slots + 1) + 1
