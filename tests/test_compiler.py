"""Every operation that a kernel may have, against JAX's own result on the same device.

The CPU runs in CI; the same tests run on an NVIDIA GPU with the marker `gpu`.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import pallas as pl

from codesign_jax.compiler import thread, vector
from codesign_jax.compiler.launch import Kernel, describe, kernel_jaxpr, launch
from codesign_jax.compiler.values import Array, Layout
from scripts import same_kernels

pytestmark = pytest.mark.usefixtures("optimized_kernels")
BACKENDS = ["cpu", pytest.param("gpu", marks=pytest.mark.gpu)]
# The oracles of steps compute in float64: these say what is wrong if those fail.
FLOATS = [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)]
INTEGERS = [np.int32, pytest.param(np.int64, marks=pytest.mark.slow)]
BLOCKS = 26
"""Enough for all pairs of the special numbers below on eight lanes."""


def lanes_of(backend):
    return 8 if backend == "cpu" else 32


def run(functions, inputs, out_dtype, backend):
    """Values of functions of vectors, one a row: (block, function, lane)."""
    lanes = inputs[0].shape[-1]

    def kernel(*refs):
        *inputs, out = refs
        values = [ref[0, :] for ref in inputs]
        for k, function in enumerate(functions):
            out[k, :] = function(*values).astype(out_dtype)

    def spec(rows):
        return pl.BlockSpec((None, rows, lanes), lambda i: (i, 0, 0))

    shape = jax.ShapeDtypeStruct((BLOCKS, len(functions), lanes), out_dtype)
    call = pl.pallas_call(
        kernel,
        grid=(BLOCKS,),
        in_specs=[spec(1)] * len(inputs),
        out_specs=spec(len(functions)),
        out_shape=shape,
    )
    names = [f"{f.__code__.co_code!r}{f.__code__.co_consts!r}" for f in functions]
    kind = Kernel(repr(names), backend, lanes)
    return jax.jit(lambda *x: launch(call, x, [shape], kind)[0])(*(x[:, None] for x in inputs))


def compare(operations, inputs, backend, out_dtype):
    """Checks operations, by name with their relative tolerance, in one kernel."""
    inputs = [jnp.asarray(x).reshape(BLOCKS, -1) for x in inputs]
    functions = [function for function, _ in operations.values()]
    got = run(functions, inputs, out_dtype, backend)
    every = jax.jit(lambda *x: [jax.vmap(f)(*x).astype(out_dtype) for f in functions])
    for k, want in enumerate(every(*inputs)):
        name, (_, tolerance) = list(operations.items())[k]
        np.testing.assert_allclose(
            np.asarray(got[:, k]),
            want,
            rtol=tolerance,
            atol=tolerance,
            err_msg=f"{name} on {backend}",
        )


SPECIAL = [0.0, -0.0, np.nan, np.inf, -np.inf, 1.0, -1.0, 2.5, -3.5, 1e-3, 7e4, 3e9, -3e9, 0.5]


def floats(backend, dtype):
    """Every pair of special numbers, filled up with random ones."""
    pairs = [(a, b) for a in SPECIAL for b in SPECIAL]
    more = BLOCKS * lanes_of(backend) - len(pairs)
    rest = 3 * np.random.default_rng(0).standard_normal((more, 2))
    return np.concatenate([pairs, rest]).T.astype(dtype)


# Relative tolerances in units of the last place: of division, roots and powers on a GPU in float32,
# which are approximate there; of sine and cosine, whose reduction and polynomial round.
ULP = 4


def float_operations(eps):
    ulp = ULP * eps
    return {
        "add": (lambda x, y: x + y, 0),
        "sub": (lambda x, y: x - y, 0),
        "mul": (lambda x, y: x * y, 0),
        "div": (lambda x, y: x / y, ulp),
        "neg": (lambda x, y: -x, 0),
        "abs": (lambda x, y: jnp.abs(x), 0),
        "max": (lambda x, y: jnp.maximum(x, y), 0),
        "min": (lambda x, y: jnp.minimum(x, y), 0),
        "clamp": (lambda x, y: jax.lax.clamp(jnp.zeros_like(x), x, jnp.ones_like(x)), 0),
        "sign": (lambda x, y: jnp.sign(x), 0),
        "square": (lambda x, y: jnp.square(x), 0),
        "power 3": (lambda x, y: jax.lax.integer_pow(x, 3), ulp),
        "power -2": (lambda x, y: jax.lax.integer_pow(x, -2), ulp),
        "power 0": (lambda x, y: jax.lax.integer_pow(x, 0), 0),
        "sqrt": (lambda x, y: jnp.sqrt(x), ulp),
        "rsqrt": (lambda x, y: jax.lax.rsqrt(jnp.abs(x)), ulp),
        "floor": (lambda x, y: jnp.floor(x), 0),
        "ceil": (lambda x, y: jnp.ceil(x), 0),
        "finite": (lambda x, y: jnp.isfinite(x), 0),
        "lt": (lambda x, y: x < y, 0),
        "le": (lambda x, y: x <= y, 0),
        "gt": (lambda x, y: x > y, 0),
        "ge": (lambda x, y: x >= y, 0),
        "eq": (lambda x, y: x == y, 0),
        "ne": (lambda x, y: x != y, 0),
        "logic": (lambda x, y: ((x < y) & ~(y > 0.3)) | ((x != x) ^ (y >= 1)), 0),
        "select": (lambda x, y: jnp.where(x < y, x, y), 0),
        "select n": (
            lambda x, y: jax.lax.select_n(jnp.clip(x.astype(jnp.int32), 0, 2), x, y, x - y),
            0,
        ),
        "order": (lambda x, y: (x < 0) < (y < 0), 0),
        "to int32": (lambda x, y: x.astype(jnp.int32), 0),
        "to bool": (lambda x, y: x.astype(bool), 0),
        "from bool": (lambda x, y: (x < y).astype(x.dtype), 0),
        "lanes": (lambda x, y: jax.lax.broadcasted_iota(jnp.int32, x.shape, 0) - 3, 0),
        "swap": (lambda x, y: jax.lax.rev(x.reshape(2, 2, -1), (1,)).reshape(x.shape), 0),
        "swap all": (lambda x, y: jax.lax.rev(x, (0,)), 0),
        "swap bool": (lambda x, y: jax.lax.rev(x < y, (0,)), 0),
        "largest": (lambda x, y: x + jnp.max(jnp.clip(y, -9, 9).astype(jnp.int32)), 0),
        "smallest": (lambda x, y: x + jnp.min(jnp.clip(y, -9, 9).astype(jnp.int32)), 0),
    }


def control_operations():
    """Loops and conditionals; every carried value has another kind."""

    def scan(x, y):
        def body(k, c):
            return (c[0] + k * x, c[1] + 2, ~c[2])

        total, count, flag = jax.lax.fori_loop(1, 8, body, (y, jnp.int32(1), jnp.bool_(False)))
        return jnp.where(flag, total, -total) + count

    def swapped(x, y):
        return jax.lax.fori_loop(0, 3, lambda k, c: (c[1], c[0] + k), (x, y))[0]

    def search(x, y):
        def going(c):
            return (jnp.max((c[0] < 9).astype(jnp.int32)) > 0) & (c[1] < 40)

        result, rounds = jax.lax.while_loop(
            going, lambda c: (jnp.minimum(c[0] + jnp.abs(y) + 1, 10), c[1] + 1), (x, jnp.int32(0))
        )
        return result + rounds

    def branch(x, y):
        some = jnp.max((x > 2).astype(jnp.int32)) > 0
        return jax.lax.cond(some, lambda: (x, y - x), lambda: (y, x))[1]

    def nested(x, y):
        def body(k, c):
            inner = jax.lax.cond(k > 1, lambda: c + k, lambda: c - y)
            return jax.lax.fori_loop(0, 2, lambda j, d: d + j * k, inner)

        return jax.lax.fori_loop(0, 4, body, x)

    names = (scan, swapped, search, branch, nested)
    return {f.__name__: (f, 1e-5) for f in names}


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_operations_on_floats(backend, dtype):
    """Of all kinds of numbers, also infinite ones and what is no number."""
    with jax.enable_x64(dtype == np.float64):
        compare(float_operations(np.finfo(dtype).eps), floats(backend, dtype), backend, dtype)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_angles_and_control(backend, dtype):
    """Sine and cosine to some units in the last place, and every kind of control flow."""
    eps = np.finfo(dtype).eps
    size = BLOCKS * lanes_of(backend)
    rng = np.random.default_rng(1)
    x, y = 3 * rng.standard_normal((2, size)).astype(dtype)
    x[:6] = [0, np.pi / 4, -np.pi / 2, 1e3, -20, 1]
    turns = {
        f"{f.__name__} {s}": (lambda x, y, f=f, s=s: f(s * x), 4 * eps)
        for f in (jnp.sin, jnp.cos)
        for s in (1, 40)
    }
    with jax.enable_x64(dtype == np.float64):
        compare(turns | control_operations(), (x, y), backend, dtype)
        x[:3] = np.nan, np.inf, -np.inf
        compare(turns, (x, y), backend, dtype)


def sum_of_pairs(x, y):
    """Products of all lanes, summed as a block sums over its fingers."""
    product = x * y
    distance = 1
    while distance < x.size:
        product = product + jax.lax.rev(product.reshape(-1, 2, distance), (1,)).reshape(x.shape)
        distance *= 2
    return product


def difference_of_pairs(x, y):
    """What a lane's product has more than its partner's, where y is positive."""
    product = x * y
    theirs = jax.lax.rev(product.reshape(2, -1), (0,)).reshape(x.shape)
    return product - jnp.where(y > 0, theirs, 0.0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_lanes_sum_after_an_exchange_has_the_same_bits_on_all(backend):
    """No lane fuses its own product with another one's rounded product.

    Fused the lanes' results differ in the last bit, and with it what all of them decide or store.
    """
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, BLOCKS, lanes_of(backend))).astype(np.float32)
    got = run([sum_of_pairs, difference_of_pairs], (x, np.abs(y)), np.float32, backend)
    assert np.ptp(got[:, 0], axis=1).max() == 0
    low, high = np.split(np.asarray(got[:, 1]), 2, axis=1)
    np.testing.assert_array_equal(low, -high)
    # LLVM fuses where it likes what it may: the text must not allow it.
    for function, sign in ((sum_of_pairs, "fadd"), (difference_of_pairs, "fsub")):
        for text in write(function, np.float32, np.float32):
            assert sign in text and f"{sign} contract" not in text
        ptx = thread.assembly(text)
        assert f"{sign[1:]}.rn.f32" in ptx and "fma" not in ptx


@pytest.mark.parametrize("dtype", INTEGERS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_operations_on_integers(backend, dtype):
    """Of all kinds of numbers, also those at which processors trap; sums wrap around."""
    info = np.iinfo(dtype)
    size = BLOCKS * lanes_of(backend)
    numbers = [0, 1, -1, 2, -7, 9, info.min, info.max]
    pairs = [(a, b) for a in numbers for b in numbers]
    pairs += [(3, 2)] * (size - len(pairs))
    operations = {
        "add": lambda x, y: x + y,
        "sub": lambda x, y: x - y,
        "mul": lambda x, y: x * y,
        "div": lambda x, y: jax.lax.div(x, y),
        "rem": lambda x, y: jax.lax.rem(x, y),
        "div by 3": lambda x, y: jax.lax.div(x, jnp.full_like(x, 3)),
        "neg": lambda x, y: -x,
        "abs": lambda x, y: jnp.abs(x),
        "sign": lambda x, y: jnp.sign(x),
        "max": lambda x, y: jnp.maximum(x, y),
        "min": lambda x, y: jnp.minimum(x, y),
        "and": lambda x, y: x & y,
        "or": lambda x, y: x | y,
        "xor": lambda x, y: x ^ y,
        "shift left": lambda x, y: jax.lax.shift_left(x, y),
        "shift right": lambda x, y: jax.lax.shift_right_logical(x, y),
        "shift right by 3": lambda x, y: jax.lax.shift_right_logical(x, jnp.full_like(x, 3)),
        "not": lambda x, y: ~x,
        "bits": lambda x, y: jax.lax.population_count(x),
        "lt": lambda x, y: x < y,
        "ge": lambda x, y: x >= y,
        "ne": lambda x, y: x != y,
        "to float": lambda x, y: x.astype(jnp.float32).astype(x.dtype) // 512,
        "bits of a float": lambda x, y: jax.lax.bitcast_convert_type(
            x.astype(jnp.float32), jnp.int32
        ).astype(x.dtype),
        "power": lambda x, y: jax.lax.integer_pow(x, 3),
        "swap": lambda x, y: jax.lax.rev(x, (0,)),
        "to other": lambda x, y: x.astype(jnp.int32).astype(x.dtype),
    }
    with jax.enable_x64(dtype == np.int64):
        exact = {name: (function, 0) for name, function in operations.items()}
        compare(exact, np.array(pairs, dtype).T, backend, dtype)


def write(function, *kinds, lanes=8):
    """A function of vectors in LLVM's language, as vectors and as threads."""

    def kernel(*refs):
        *inputs, out = refs
        out[0, :] = function(*(ref[0, :] for ref in inputs))

    for writer, size in ((vector, lanes), (thread, 32)):
        spec = pl.BlockSpec((None, 1, size), lambda i: (i, 0, 0))
        inputs = [jax.ShapeDtypeStruct((2, 1, size), k) for k in kinds]
        call = pl.pallas_call(
            kernel, grid=(2,), in_specs=[spec] * len(kinds), out_specs=spec, out_shape=inputs[0]
        )
        (equation,) = jax.make_jaxpr(call)(*inputs).eqns
        blocks = [((1, size), k) for k in (*kinds, kinds[0])]
        if writer is vector:
            yield vector.write(equation.params["jaxpr"], blocks, size)
            continue
        arrays = tuple(Array(shape, np.dtype(k).name) for shape, k in blocks)
        yield thread.write(equation.params["jaxpr"], Layout(arrays, size), "test")


@pytest.mark.parametrize(
    ("function", "kind", "message"),
    [
        (jnp.tanh, np.float32, "'tanh'"),
        (lambda x: x + x.astype(np.float16).astype(np.float32), np.float32, "no dtype float16"),
        (lambda x: x + 1, np.uint32, "no dtype uint32"),
        (lambda x: jnp.where(jnp.max(x) > 0, x, 0), np.float32, "reduces int32 .* not float32"),
        (
            lambda x: jax.lax.scan(lambda c, k: (c + k, c), x, jnp.arange(3.0))[0],
            np.float32,
            "no inputs or outputs of each round",
        ),
    ],
)
def test_what_has_no_instruction_is_named(function, kind, message):
    """Instead of a wrong result, and before anything runs."""
    with pytest.raises(NotImplementedError, match=message):
        list(write(function, kind))


def exchange(lanes, backend):
    """A kernel of two tables that lanes share columns of, the second one on a GPU's chip.

    Each of four lanes stores a product and reads all four, twice from the same places.
    """
    columns = lanes // 4

    def kernel(x, out, table, onchip):
        lane = jax.lax.broadcasted_iota(jnp.int32, (lanes,), 0)
        column = jax.lax.rem(lane, columns)
        mate = jax.lax.div(lane, columns)

        def body(k, total):
            for ref in (table, onchip):
                ref[mate, column] = x[0, :] * (mate + k).astype(jnp.float32)
                total = (
                    total
                    + ref[0, column]
                    + ref[1, column] * 2
                    + ref[2, column] * 4
                    + ref[3, column] * 8
                )
            return total

        out[0, :] = jax.lax.fori_loop(0, 3, body, jnp.zeros(lanes))

    def spec(rows, width):
        return pl.BlockSpec((None, rows, width), lambda i: (i, 0, 0))

    sizes = ((1, lanes), (4, columns), (4, columns))
    outputs = [jax.ShapeDtypeStruct((BLOCKS, *size), jnp.float32) for size in sizes]
    call = pl.pallas_call(
        kernel,
        grid=(BLOCKS,),
        in_specs=[spec(1, lanes)],
        out_specs=[spec(*size) for size in sizes],
        out_shape=outputs,
    )
    return call, outputs, Kernel("exchange", backend, lanes, (), (1,), (2,), (1, 2))


@pytest.mark.parametrize("backend", BACKENDS)
def test_lanes_exchange_through_memory(backend):
    """Of lanes that share a column each reads what the others have stored, in every round."""
    lanes = lanes_of(backend)
    call, outputs, kind = exchange(lanes, backend)
    x = np.random.default_rng(4).integers(0, 99, (BLOCKS, 1, lanes)).astype(np.float32)
    got = jax.jit(lambda x: launch(call, (x,), outputs, kind)[0])(x)
    each = x.reshape(BLOCKS, 4, -1)
    rounds = [each * (np.arange(4) + k)[:, None] for k in range(3)]
    want = sum(2 * np.einsum("bmc,m->bc", r, [1, 2, 4, 8]) for r in rounds)
    np.testing.assert_array_equal(got, np.tile(want[:, None], (1, 1, 4)))


SUMS = """entry:
br label %L1
L1:
%v1 = phi i32 [ 0, %entry ], [ %v6, %L1 ]
%v2 = getelementptr float, ptr %a0, i32 %v1
%v3 = load float, ptr %v2
%v4 = load float, ptr %a1
%v5 = fadd float %v3, %v4
store float %v5, ptr %v2
%v6 = add i32 %v1, 1
br label %L1"""
REORDERED = """entry:
br label %L1
L1:
%v1 = phi i32 [ 0, %entry ], [ %v2, %L1 ]
%v2 = add i32 %v1, 1
%v3 = load float, ptr %a1
%v4 = getelementptr float, ptr %a0, i32 %v1
%v5 = load float, ptr %v4
%v6 = fadd float %v5, %v3
store float %v6, ptr %v4
br label %L1"""
OTHER_KERNELS = {
    "another step of the loop": ("add i32 %v1, 1", "add i32 %v1, 2"),
    "another value": ("fadd float %v5, %v3", "fadd float %v5, %v5"),
    "another address": ("store float %v6, ptr %v4", "store float %v6, ptr %a1"),
    "a load behind the store": (
        "%v6 = fadd float %v5, %v3\nstore float %v6, ptr %v4",
        "store float %v3, ptr %v4\n%v6 = load float, ptr %a1\nstore float %v6, ptr %v4",
    ),
}


def test_kernels_are_the_same_but_for_the_order_of_operations():
    assert REORDERED != SUMS
    assert same_kernels.without_order(REORDERED) == same_kernels.without_order(SUMS)


@pytest.mark.parametrize("change", OTHER_KERNELS.values(), ids=OTHER_KERNELS)
def test_kernels_that_compute_something_else_are_not_the_same(change):
    other = REORDERED.replace(*change)
    assert other != REORDERED
    assert same_kernels.without_order(other) != same_kernels.without_order(SUMS)


def test_a_gpu_exchanges_on_its_chip_between_barriers():
    """Lanes meet between storing and reading, and between reading and storing again."""
    call, outputs, kind = exchange(32, "gpu")
    x = jax.ShapeDtypeStruct((BLOCKS, 1, 32), jnp.float32)
    layout = describe((x,), outputs, kind)
    assert [a.role for a in layout.arrays] == ["input", "output", "output", "onchip"]
    text = thread.write(kernel_jaxpr(call, [x]), layout, "test")
    steps = re.findall(r"call void @llvm.nvvm.(bar)|(store|load) float.*%v\d+, align", text)
    steps = [meets or access for meets, access in steps]
    once = ["bar", "store", "bar", *["load"] * 4]
    assert steps == ["load", *once, "load", *once, "store"]
    ptx = thread.assembly(text)
    assert ".shared .align 16 .b8 s3[128]" in ptx and "st.shared" in ptx and "ld.shared" in ptx
    _, large, _ = exchange(32, "gpu")
    large[2] = jax.ShapeDtypeStruct((BLOCKS, 1000, 8), jnp.float32)
    assert describe((x,), large, kind).arrays[3].role == "output"
