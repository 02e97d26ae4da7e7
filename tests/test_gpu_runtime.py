"""Kernels on a GPU: launched by XLA through the foreign function interface; `pytest -m gpu`."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax.compiler import gpu, launch, thread
from tests.helpers import kernels

pytestmark = pytest.mark.gpu

# Ten rounds of a map that doubles differences; a few roundings of 6e-8 in each.
TOLERANCE = 2**10 * 4 * 6e-8


@pytest.fixture(scope="module", autouse=True)
def available():
    """Skips where there is no GPU; where there is one, kernels must be available."""
    if jax.default_backend() != "gpu":
        pytest.skip("no GPU")
    assert launch.available("gpu") is None


def run(x, table, rounds=10):
    return kernels.run(x, table, rounds, backend="gpu")


def batch(blocks):
    return kernels.numbers(blocks, lanes=thread.LANES)


@pytest.mark.parametrize("blocks", [1, 2, 133, 5000])
def test_launch(blocks):
    """Any number of blocks, a shared array and scratch memory of every block's own."""
    x, table = batch(blocks)
    got = jax.jit(run)(x, table)
    np.testing.assert_allclose(got, kernels.expected(x, table), atol=TOLERANCE)


def test_two_calls_of_one_program():
    """One call's results are the next one's input, between operations of XLA's own."""
    x, table = batch(64)

    def twice(x, table):
        first = run(x, table)
        return run(x.at[:, :1].set(first / first.max()), table + 0.0), first

    second, first = jax.jit(twice)(x, table)
    np.testing.assert_array_equal(first, jax.jit(run)(x, table))
    following = x.copy()
    following[:, :1] = first / np.max(first)
    np.testing.assert_allclose(second, kernels.expected(following, table), atol=TOLERANCE)


def test_calls_in_a_loop_and_many_in_flight():
    """Programs that were started together, and launches inside of a scan, keep their order."""
    x, table = map(jnp.asarray, batch(256))

    def step(x, _):
        return x.at[:, :1].set(jnp.clip(run(x, table) / 2, 0, 1)), None

    looped = jax.jit(lambda x: jax.lax.scan(step, x, None, length=20)[0])
    alone = jax.jit(lambda x: step(x, None)[0])
    want = x
    for _ in range(20):
        want = alone(want)
    started = [looped(x) for _ in range(8)]
    for got in started:
        np.testing.assert_array_equal(got, want)


def test_every_device():
    """One handle of the kernel serves all GPUs of the host, each on its own stream."""
    x, table = batch(300)
    program = jax.jit(partial(run, rounds=200))
    placed = [jax.device_put((x, table), d) for d in jax.local_devices()]
    started = [program(*p) for p in placed for _ in range(3)]
    for got, device in zip(started[::3], jax.local_devices(), strict=True):
        assert got.devices() == {device}
    for got in started:
        np.testing.assert_array_equal(got, np.asarray(started[0]))


def test_shares_of_a_mesh():
    """The blocks dealt to the host's GPUs by `shard_map`, be it one."""
    devices = jax.local_devices()
    mesh, spec = jax.sharding.Mesh(np.array(devices), ("device",)), jax.sharding.PartitionSpec
    x, table = batch(12 * len(devices))
    share = jax.shard_map(
        run, mesh=mesh, in_specs=(spec("device"), spec()), out_specs=spec("device")
    )
    np.testing.assert_array_equal(jax.jit(share)(x, table), jax.jit(run)(x, table))


def test_what_the_driver_refuses(monkeypatch):
    """PTX with an error: told before anything runs, with the assembler's words."""
    text = gpu.device_code

    def broken(jaxpr, layout):
        return text(jaxpr, layout).replace("ret;", "return;")

    monkeypatch.setattr(gpu, "device_code", broken)
    with pytest.raises(launch.KernelUnavailable, match="CUDA_ERROR_INVALID_PTX"):
        jax.jit(partial(run, rounds=3)).lower(*batch(2))


def test_a_failing_launch_is_an_exception(monkeypatch):
    """A kernel that no GPU can launch: the driver's error reaches Python, and JAX goes on."""
    monkeypatch.setattr(gpu, "load", lambda *_: 0)
    x, table = batch(2)
    with pytest.raises(Exception, match="cuLaunchKernel: CUDA_ERROR_"):
        jax.block_until_ready(jax.jit(partial(run, rounds=4))(x, table))
    monkeypatch.undo()
    got = jax.jit(run)(x, table)
    np.testing.assert_allclose(got, kernels.expected(x, table), atol=TOLERANCE)
