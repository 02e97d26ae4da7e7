"""How kernels reach XLA on a CPU: threads, checks, versions, fallback, and kept machine code."""

import ctypes
import importlib.metadata
import os
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from codesign_jax.compiler import cpu, ffi, gpu, handlers, launch
from codesign_jax.compiler.values import OUTPUT, SCRATCH, Array, Layout
from tests.helpers import call_frames, kernels

pytestmark = pytest.mark.usefixtures("optimized_kernels")

LAYOUT = Layout(
    (
        Array((2, 8), "float32"),
        Array((1, 8), "float32", shared=True),
        Array((1, 8), "float32", OUTPUT),
        Array((3, 8), "float32", SCRATCH),
    ),
    8,
)


@pytest.fixture(scope="module")
def handler():
    """Address of the handler of `kernels.body`, not registered."""
    x, table = (jax.ShapeDtypeStruct(v.shape, v.dtype) for v in kernels.numbers(4))
    jaxpr = launch.kernel_jaxpr(kernels.call(x, table)[0], [x, table])
    text = cpu.block_code(jaxpr, LAYOUT) + cpu.handler_code("plain", LAYOUT)
    return handlers.Loaded(handlers.compile(text)).function("plain")


@pytest.fixture
def folder(tmp_path):
    """A folder where kernels are kept."""
    previous = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", previous)


# Threads


@pytest.mark.parametrize("pool", ["late", "at once", "threads", "refused"])
@pytest.mark.parametrize(("threads", "blocks"), [(0, 3), (1, 3), (4, 1), (4, 2), (4, 100), (3, 0)])
def test_any_number_of_threads_gives_the_same_bits(handler, pool, threads, blocks):
    """One task less than threads and blocks; a pool that runs none of them in time does not matter.

    Tasks that run late look at the call's record after the handler has returned.
    """
    x, table = kernels.numbers(blocks)
    xla, out = call_frames.Xla(threads, pool), np.full((blocks, 1, 8), np.nan, np.float32)
    assert xla.call(handler, [x, table], [out]) is None
    alone = np.empty_like(out)
    assert call_frames.Xla(1).call(handler, [x, table], [alone]) is None
    np.testing.assert_array_equal(out, alone)
    # Ten rounds of a map that doubles differences; a few roundings of 6e-8 in each.
    np.testing.assert_allclose(out, kernels.expected(x, table), atol=2**10 * 4 * 6e-8)
    wanted = max(min(threads, blocks) - 1, 0)
    assert xla.scheduled == (min(wanted, 2) if pool == "refused" else wanted)
    assert len(xla.destroyed) == len(xla.errors)
    xla.run_late()
    np.testing.assert_array_equal(out, alone)


def test_calls_of_one_program_and_of_many_threads():
    """Several calls at once, in one program and from several threads, find the pool busy."""
    batches = [kernels.numbers(n) for n in (1, 2, 7, 64)]
    program = jax.jit(lambda b: [kernels.run(x, t, 500) for x, t in b]).lower(batches).compile()
    want, found = program(batches), []
    alone = [jax.jit(partial(kernels.run, rounds=500))(x, t) for x, t in batches]
    call = [lambda: found.append(jax.block_until_ready(program(batches)))] * 4
    threads = [threading.Thread(target=c) for c in call]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert len(found) == 4
    for got in [alone, *found]:
        jax.tree.map(np.testing.assert_array_equal, want, got)


DEVICES = """
import jax, sys
jax.config.update("jax_num_cpu_devices", 3)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
import numpy as np
from jax.sharding import Mesh, PartitionSpec as P
from codesign_jax.compiler import vector
from tests.helpers import kernels
vector.write = None  # the machine code is there
x, table = kernels.numbers(12)
alone = jax.jit(kernels.run)(x, table)
mesh = Mesh(np.array(jax.devices()), ("device",))
for check in (False, True):
    share = jax.shard_map(
        kernels.run, mesh=mesh, in_specs=(P("device"), P()), out_specs=P("device"), check_vma=check
    )
    got = jax.jit(share)(x, table)
    assert len(got.devices()) == 3
    np.testing.assert_array_equal(got, alone)
try:
    jax.jit(jax.shard_map(kernels.run, mesh=mesh, in_specs=(P("device"), P()), out_specs=P()))(
        x, table
    )
except ValueError as error:
    assert "out_specs" in str(error), error
else:
    raise AssertionError("results that differ between devices were taken for equal ones")
"""


def test_kept_code_runs_in_another_process_on_several_devices(folder):
    """Shares of `shard_map` use the pool together; XLA knows that their results differ."""
    x, table = kernels.numbers(12)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(handlers, "known", lambda name: False)  # another test may have compiled it
        patch.setattr(handlers, "register", lambda *_: None)
        jax.jit(kernels.run).lower(x, table)
    assert list(folder.rglob("*.kept"))
    here = {**os.environ, "PYTHONPATH": os.pathsep.join([".", *sys.path])}
    done = subprocess.run(
        [sys.executable, "-c", DEVICES, str(folder)],
        env=here,
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


# What a handler refuses


def test_arrays_of_another_kind_are_refused():
    """By XLA's own call: an exception that names the array, and nothing is written."""
    x, table = kernels.numbers(3)
    lowered = jax.jit(kernels.run).lower(x, table).as_text()
    name = next(w for w in lowered.replace("@", " ").replace("(", " ").split() if "kernel_" in w)
    out = jax.ShapeDtypeStruct((3, 1, 8), np.float32)

    def call(x, table, out=out):
        return jax.block_until_ready(jax.jit(lambda *a: jax.ffi.ffi_call(name, out)(*a))(x, table))

    call(x, table)
    wrong = {
        "array 0 to be input": (x[:, :, :4], table),
        "array 0 to be": (x[0], table),
        "array 1 to be input float32.1, 1, 8.": (x, np.concatenate([table] * 3)),
        "array 1 to be input": (x, table.astype(np.int32)),
        "array 2 to be output": (x, table, jax.ShapeDtypeStruct((4, 1, 8), np.float32)),
        "2 inputs": None,
    }
    for message, arguments in wrong.items():
        with pytest.raises(Exception, match=f"INVALID_ARGUMENT.*needs {message}"):
            if arguments is None:
                jax.block_until_ready(jax.ffi.ffi_call(name, out)(x))
            else:
                call(*arguments)


@pytest.mark.parametrize("threads", [1, 4])
def test_missing_memory_is_an_error(threads):
    """Scratch memory of a petabyte: the call fails, and says why."""
    large = Layout((*LAYOUT.arrays[:3], Array((2**40, 256), "float32", SCRATCH)), 8)
    block = "define internal void @block(ptr %a, ptr %b, ptr %c, ptr %d) {\nret void\n}\n"
    loaded = handlers.Loaded(handlers.compile(block + cpu.handler_code("large", large)))
    (x, table), out = kernels.numbers(8), np.zeros((8, 1, 8), np.float32)
    xla = call_frames.Xla(threads, "threads")
    code, message = xla.call(loaded.function("large"), [x, table], [out])
    xla.run_late()
    assert code == ffi.RESOURCE_EXHAUSTED and "scratch" in message


# The interface's version and structures


def test_a_newer_version_is_refused_by_xla(monkeypatch):
    """Which checks the version that handlers claim; the next kernel runs as before."""
    x, table = kernels.numbers(2)
    monkeypatch.setattr(ffi, "MINOR", 99)
    with pytest.raises(launch.KernelUnavailable, match=r"API version \(0\.99\) is incompatible"):
        jax.jit(partial(kernels.run, rounds=3)).lower(x, table)
    monkeypatch.undo()
    jax.jit(partial(kernels.run, rounds=4))(x, table)


# Where kernels cannot run


def gpus(monkeypatch, capability):
    device = SimpleNamespace(device_kind="NVIDIA T4", compute_capability=capability)
    monkeypatch.setattr(jax, "local_devices", lambda backend: [device])


def old_llvmlite(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.44.1")


def old_gpu(monkeypatch):
    gpus(monkeypatch, "7.5")


def old_driver(monkeypatch):
    def version(pointer):
        pointer._obj.value = 11080
        return 0

    library = SimpleNamespace(cuInit=lambda _: 0, cuDriverGetVersion=version)
    gpus(monkeypatch, "9.0")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)


@pytest.mark.parametrize(
    ("platform", "cause", "reason"),
    [
        ("cpu", old_llvmlite, "llvmlite 0.44.1 is older than 0.45"),
        ("gpu", old_gpu, "NVIDIA T4 has compute capability 7.5, kernels need 8.0"),
        ("gpu", old_driver, "supports CUDA 11.8; kernels need 12.0"),
        ("tpu", lambda monkeypatch: None, "not for 'tpu'"),
    ],
)
def test_why_kernels_cannot_run(monkeypatch, platform, cause, reason):
    """Each reason is named, and launching says the same."""
    launch.available.cache_clear()
    gpu.driver.cache_clear()
    cause(monkeypatch)
    try:
        found = launch.available(platform)
        assert found is not None
        with pytest.raises(launch.KernelUnavailable, match=reason):
            kernels.run(*kernels.numbers(2), backend=platform)
    finally:
        monkeypatch.undo()
        launch.available.cache_clear()
        gpu.driver.cache_clear()
        ffi.installed_version.cache_clear()
    assert launch.available("cpu") is None
