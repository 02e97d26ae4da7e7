"""How kernels reach XLA, on CPUs and NVIDIA GPUs: threads, checks, versions, kept machine code."""

import ctypes
import importlib.metadata
import os
import subprocess
import sys
import threading
from concurrent import futures
from ctypes import POINTER, c_char_p, c_int, c_int64, c_uint, c_void_p
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from codesign_jax.compiler import cpu, ffi, gpu, handlers, launch
from codesign_jax.compiler.values import OUTPUT, SCRATCH, Array, Layout
from tests.helpers import kernels

pytestmark = pytest.mark.usefixtures("optimized_kernels")

FUNCTION = ctypes.CFUNCTYPE(c_void_p, c_void_p)
NEVER_CALLED = 0xBAD
STREAM = 0x57EA


class Xla:
    """Functions that handlers call, which note what they were asked for.

    Error k is the pointer k + 1; `tasks` have not been run yet, `scheduled` were asked for.
    """

    def __init__(self, threads=1, pool="late", stream_error=0):
        """No pool with 0 threads; its tasks run "at once", "late", in "threads", or never."""
        self.errors = []
        self.destroyed = []
        self.tasks = []
        self.scheduled = 0
        self.threads = threads
        self.pool = pool
        self.stream_error = stream_error
        self.running = []
        named = {
            "error_create": self._create,
            "error_destroy": self._destroy,
            "stream_get": self._stream,
            "thread_pool_schedule": self._schedule,
            "thread_pool_num_threads": self._num_threads,
        }
        self.functions = {name: FUNCTION(function) for name, function in named.items()}
        self.api = ffi.Api(struct_size=ffi.size(ffi.Api))
        for name, function in self.functions.items():
            setattr(self.api, name, ctypes.cast(function, c_void_p))

    def call(self, address, inputs, outputs):
        """Calls a handler on NumPy arrays; its error's code and message, or None."""
        keep = []

        def arguments(arrays):
            buffers = [self._buffer(a, keep) for a in arrays]
            pointers = (c_void_p * len(arrays))(*(ctypes.addressof(b) for b in buffers))
            keep.extend([*buffers, pointers])
            size = ffi.size(ffi.Arguments)
            values = ctypes.addressof(pointers)
            return ffi.Arguments(struct_size=size, size=len(arrays), values=values)

        operands = {"args": arguments(inputs), "rets": arguments(outputs)}
        api = ctypes.addressof(self.api)
        size = ffi.size(ffi.CallFrame)
        frame = ffi.CallFrame(struct_size=size, api=api, stage=3, **operands)
        pointer = FUNCTION(address)(ctypes.addressof(frame))
        return self.errors[pointer - 1] if pointer else None

    def _buffer(self, array, keep):
        dims = (c_int64 * array.ndim)(*array.shape)
        keep.extend([dims, array])
        return ffi.Buffer(
            struct_size=ffi.size(ffi.Buffer),
            dtype=ffi.DTYPES[array.dtype.name],
            data=array.ctypes.data,
            rank=array.ndim,
            dims=ctypes.addressof(dims),
        )

    def run_late(self):
        """Runs the tasks that wait, and waits for those that run."""
        while self.tasks:
            self.tasks.pop()()
        for thread in self.running:
            thread.join()

    def _create(self, record):
        request = ffi.ErrorCreate.from_address(record)
        self.errors.append((request.errc, ctypes.string_at(request.message).decode()))
        return len(self.errors)

    def _destroy(self, record):
        self.destroyed.append(ffi.ErrorDestroy.from_address(record).error)
        return None

    def _stream(self, record):
        ffi.StreamGet.from_address(record).stream = STREAM
        return self.stream_error or None

    def _num_threads(self, record):
        if not self.threads:
            self.errors.append((12, "no pool"))
            return len(self.errors)
        request = ffi.NumThreads.from_address(record)
        c_int64.from_address(request.num_threads).value = self.threads
        return None

    def _schedule(self, record):
        request = ffi.Schedule.from_address(record)
        function = ctypes.CFUNCTYPE(None, c_void_p)(request.task)
        data = request.data
        self.scheduled += 1
        if self.pool == "refused" and self.scheduled > 1:
            self.errors.append((8, "the pool is full"))
            return len(self.errors)
        if self.pool == "at once":
            function(data)
        elif self.pool == "threads":
            self.running.append(threading.Thread(target=function, args=(data,)))
            self.running[-1].start()
        else:
            self.tasks.append(lambda: function(data))
        return None


def arrays(layout, blocks, seed=0):
    """Random inputs and empty outputs of a layout, as NumPy arrays."""
    rng = np.random.default_rng(seed)
    by_role = {"input": [], "output": []}
    for array in layout.arrays:
        if array.role in by_role:
            shape = (1 if array.shared else blocks, *array.shape)
            values = rng.standard_normal(shape) if array.role == "input" else np.zeros(shape)
            by_role[array.role].append(values.astype(array.dtype))
    return by_role["input"], by_role["output"]


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
    loaded = handlers.prepare(cpu.handler_code("plain", LAYOUT), keep=False)
    code = handlers.Loaded(handlers.compile(cpu.object_text(jaxpr, LAYOUT)))
    handlers.supply("plain", loaded, lambda: code.function(cpu.ENTRY)).join()
    return loaded.function("plain")


@pytest.fixture
def folder(tmp_path):
    """A folder where kernels are kept."""
    previous = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", previous)


@pytest.mark.parametrize("pool", ["late", "at once", "threads", "refused"])
@pytest.mark.parametrize(("threads", "blocks"), [(0, 3), (1, 3), (4, 1), (4, 2), (4, 100), (3, 0)])
def test_any_number_of_threads_gives_the_same_bits(handler, pool, threads, blocks):
    """One task less than threads and blocks; a pool that runs none of them in time does not matter.

    Tasks that run late look at the call's record after the handler has returned.
    """
    x, table = kernels.numbers(blocks)
    xla = Xla(threads, pool)
    out = np.full((blocks, 1, 8), np.nan, np.float32)
    assert xla.call(handler, [x, table], [out]) is None
    alone = np.empty_like(out)
    assert Xla(1).call(handler, [x, table], [alone]) is None
    np.testing.assert_array_equal(out, alone)
    # Ten rounds of a map that doubles differences; a few roundings of 6e-8 in each.
    np.testing.assert_allclose(out, kernels.expected(x, table), atol=2**10 * 4 * 6e-8)
    tasks = max(min(threads, blocks) - 1, 0)
    assert xla.scheduled == (min(tasks, 2) if pool == "refused" else tasks)
    assert len(xla.destroyed) == len(xla.errors)
    xla.run_late()
    np.testing.assert_array_equal(out, alone)


def test_calls_of_one_program_and_of_many_threads():
    """Several calls at once, in one program and from several threads, find the pool busy."""
    batches = [kernels.numbers(n) for n in (1, 2, 7, 64)]
    program = jax.jit(lambda b: [kernels.run(x, t, 500) for x, t in b]).lower(batches).compile()
    want = program(batches)
    results = []
    alone = [jax.jit(partial(kernels.run, rounds=500))(x, t) for x, t in batches]
    call = [lambda: results.append(jax.block_until_ready(program(batches)))] * 4
    threads = [threading.Thread(target=c) for c in call]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert len(results) == 4
    for got in [alone, *results]:
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
from codesign_jax.devices import shared_out
weighed = lambda factor, worlds: {"product": factor * worlds["x"], "sum": worlds["x"].sum(1)}
runs = jax.vmap(shared_out(weighed, 3), in_axes=(None, 0))  # seven worlds of two runs
worlds = {"x": np.arange(42.0, dtype=np.float32).reshape(2, 7, 3)}
got = jax.jit(runs)(2.0, worlds)
np.testing.assert_array_equal(got["product"], 2 * worlds["x"])
np.testing.assert_array_equal(got["sum"], worlds["x"].sum(2))
assert len(got["sum"].devices()) == 3
"""


def test_kept_code_runs_in_another_process_on_several_devices(folder):
    """Shares of `shard_map` use the pool together; XLA knows that their results differ.

    And `devices.shared_out`, by which a task's worlds are shared.
    """
    x, table = kernels.numbers(12)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(handlers, "known", lambda name: False)  # another test may have compiled it
        patch.setattr(handlers, "register", lambda *_: None)
        jax.jit(kernels.run).lower(x, table)
    for thread in threading.enumerate():
        if thread.name.startswith("compiles"):
            thread.join()
    assert list(folder.rglob("*.kept"))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([".", *sys.path])}
    done = subprocess.run(
        [sys.executable, "-c", DEVICES, str(folder)],
        env=environment,
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


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


def test_a_call_waits_for_its_kernel():
    """Which is compiled meanwhile; an error in that is the calls', whenever they begin."""
    x, table = kernels.numbers(3)
    out = np.zeros((3, 1, 8), np.float32)
    compiled = threading.Event()

    def fails():
        compiled.wait()
        raise RuntimeError("LLVM refused")

    loaded = handlers.prepare(cpu.handler_code("waits", LAYOUT), keep=False)
    compiling = handlers.supply("waits", loaded, fails)
    with futures.ThreadPoolExecutor() as pool:
        call = pool.submit(Xla().call, loaded.function("waits"), [x, table], [out])
        with pytest.raises(TimeoutError):
            call.result(timeout=0.1)
        compiled.set()
        error = (ffi.INTERNAL, "kernel waits: LLVM refused")
        assert call.result(timeout=10) == error
    compiling.join()
    assert Xla().call(loaded.function("waits"), [x, table], [out]) == error


@pytest.mark.parametrize("threads", [1, 4])
def test_missing_memory_is_an_error(threads):
    """Scratch memory of a petabyte: the call fails, and says why."""
    large = Layout((*LAYOUT.arrays[:3], Array((2**40, 256), "float32", SCRATCH)), 8)
    loaded = handlers.prepare(cpu.handler_code("large", large), keep=False)
    handlers.supply("large", loaded, lambda: NEVER_CALLED).join()
    x, table = kernels.numbers(8)
    out = np.zeros((8, 1, 8), np.float32)
    xla = Xla(threads, "threads")
    code, message = xla.call(loaded.function("large"), [x, table], [out])
    xla.run_late()
    assert code == ffi.RESOURCE_EXHAUSTED and "scratch" in message


def test_a_newer_version_is_refused_by_xla(monkeypatch):
    """Which checks the version that handlers claim; the next kernel runs as before."""
    x, table = kernels.numbers(2)
    # Asks the headers of XLA's interface, once in a process: later it is XLA that refuses.
    assert launch.available("cpu") is None
    monkeypatch.setattr(ffi, "MINOR", 99)
    with pytest.raises(launch.KernelUnavailable, match=r"API version \(0\.99\) is incompatible"):
        jax.jit(partial(kernels.run, rounds=3)).lower(x, table)
    monkeypatch.undo()
    jax.jit(partial(kernels.run, rounds=4))(x, table)


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
        problem = launch.available(platform)
        assert problem is not None
        with pytest.raises(launch.KernelUnavailable, match=reason):
            kernels.run(*kernels.numbers(2), backend=platform)
    finally:
        monkeypatch.undo()
        launch.available.cache_clear()
        gpu.driver.cache_clear()
        ffi.installed_version.cache_clear()
    assert launch.available("cpu") is None


# --- launching on NVIDIA GPUs, with a driver and an XLA of our own --------------------------------


KERNEL = 0xCAFE
CONTEXT = 0xC0
PRIMARY = 0xC1
NAMES = {1: b"CUDA_ERROR_INVALID_VALUE", 218: b"CUDA_ERROR_INVALID_PTX"}
GPU_LAYOUT = Layout(
    (
        Array((2, 32), "float32"),
        Array((5,), "int32", shared=True),
        Array((1, 32), "float64", OUTPUT),
        Array((3, 32), "float32", OUTPUT),
    ),
    32,
)


class FakeDriver:
    """The driver's functions, which note their calls and return `results` by their names."""

    def __init__(self, **results):
        """Starts."""
        self.calls = []
        self.results = results
        kinds = {
            "cuStreamGetCtx": [c_void_p, POINTER(c_void_p)],
            "cuCtxPushCurrent_v2": [c_void_p],
            "cuCtxPopCurrent_v2": [POINTER(c_void_p)],
            "cuLaunchKernel": [c_void_p, *[c_uint] * 7, c_void_p, POINTER(c_void_p), c_void_p],
            "cuGetErrorName": [c_int, POINTER(c_char_p)],
            "cuLibraryLoadData": [
                *(POINTER(c_void_p), c_char_p, POINTER(c_int), POINTER(c_void_p), c_uint),
                *(c_void_p, c_void_p, c_uint),
            ],
            "cuLibraryGetKernel": [POINTER(c_void_p), c_void_p, c_char_p],
            "cuDevicePrimaryCtxRetain": [POINTER(c_void_p), c_int],
            "cuDevicePrimaryCtxRelease_v2": [c_int],
            "cuKernelGetFunction": [POINTER(c_void_p), c_void_p],
        }
        for name, arguments in kinds.items():
            function = ctypes.CFUNCTYPE(c_int, *arguments)(self._answer(name))
            setattr(self, name, function)

    def _answer(self, name):
        def answer(*args):
            if name == "cuGetErrorName":
                if args[0] not in NAMES:
                    return 1
                args[1][0] = NAMES[args[0]]
                return 0
            known = {"cuStreamGetCtx": CONTEXT, "cuDevicePrimaryCtxRetain": PRIMARY}
            if name in known:
                args[-1 if name == "cuStreamGetCtx" else 0][0] = known[name]
            if name in ("cuLibraryLoadData", "cuLibraryGetKernel", "cuKernelGetFunction"):
                args[0][0] = KERNEL
            noted = args
            if name == "cuLaunchKernel":
                addresses = [c_void_p.from_address(args[9][k]).value for k in range(4)]
                noted = (*args[:9], addresses, args[10])
            if name == "cuLibraryLoadData" and self.results:
                ctypes.memmove(args[3][0], b"line 3: syntax error\0", 21)
            self.calls.append((name, noted))
            return self.results.get(name, 0)

        return answer


@pytest.fixture(scope="module")
def prepared():
    """A handler and what sets the driver that it calls."""
    fake = FakeDriver()
    loaded = gpu.prepare("fake", GPU_LAYOUT, gpu.Driver(fake), keep=False)
    handlers.supply("fake", loaded, lambda: KERNEL).join()

    def use(driver):
        table = loaded.numbers("fake_table", len(gpu.CALLS))
        for k, name in enumerate(gpu.CALLS):
            table[k] = gpu.Driver(driver).address(name)
        return driver

    return loaded.function("fake"), use, fake


def test_launch(prepared):
    """Grid, block, stream and the address of every array's first block, in the stream's context."""
    handler, use, _ = prepared
    driver = use(FakeDriver())
    xla = Xla()
    for blocks in (1, 7):
        inputs, outputs = arrays(GPU_LAYOUT, blocks)
        assert xla.call(handler, inputs, outputs) is None
        addresses = [a.ctypes.data for a in (*inputs, *outputs)]
        names, arguments = zip(*driver.calls, strict=True)
        assert names == ("cuStreamGetCtx", "cuCtxPushCurrent_v2", "cuLaunchKernel") + (
            "cuCtxPopCurrent_v2",
        )
        assert arguments[0][0] == STREAM and arguments[1] == (CONTEXT,)
        assert arguments[2] == (*(KERNEL, blocks, 1, 1, 32, 1, 1, 0, STREAM, addresses, None),)
        driver.calls.clear()
    inputs, outputs = arrays(GPU_LAYOUT, 0)
    assert xla.call(handler, inputs, outputs) is None and not driver.calls


@pytest.mark.parametrize(
    ("function", "result", "message"),
    [
        ("cuLaunchKernel", 1, r"kernel fake: cuLaunchKernel: CUDA_ERROR_INVALID_VALUE (1)"),
        ("cuLaunchKernel", 77, r"kernel fake: cuLaunchKernel: unknown error (77)"),
        ("cuStreamGetCtx", 1, r"kernel fake: cuStreamGetCtx: CUDA_ERROR_INVALID_VALUE (1)"),
        ("cuCtxPopCurrent_v2", 1, r"kernel fake: cuCtxPopCurrent: CUDA_ERROR_INVALID_VALUE (1)"),
    ],
)
def test_errors_of_the_driver(prepared, function, result, message):
    """They name the call and the result; the context is restored after a launch that failed."""
    handler, use, _ = prepared
    driver = use(FakeDriver(**{function: result}))
    xla = Xla()
    assert xla.call(handler, *arrays(GPU_LAYOUT, 2)) == (ffi.INTERNAL, message)
    names = [name for name, _ in driver.calls]
    assert ("cuLaunchKernel" in names) == ("cuCtxPopCurrent_v2" in names)
    assert "cuLaunchKernel" not in names or function in ("cuLaunchKernel", "cuCtxPopCurrent_v2")


def test_errors_of_xla(prepared):
    """No stream: XLA's own error is handed back.  Arrays of another kind are not launched on."""
    handler, use, _ = prepared
    driver = use(FakeDriver())
    xla = Xla(stream_error=1)
    xla.errors.append((9, "no stream"))
    inputs, outputs = arrays(GPU_LAYOUT, 2)
    assert xla.call(handler, inputs, outputs) == (9, "no stream")
    for wrong in ([inputs[0], inputs[0]], [inputs[0][:, :1], inputs[1]], inputs[:1]):
        code, message = Xla().call(handler, wrong, outputs)
        assert code == ffi.INVALID_ARGUMENT and message.startswith("kernel fake needs ")
    assert not driver.calls


def test_loading():
    """PTX becomes a kernel of a library, which is translated in a GPU's primary context."""
    driver = FakeDriver()
    assert gpu.load(gpu.Driver(driver), "the text", 3) == KERNEL
    calls = dict(driver.calls)
    assert calls["cuLibraryLoadData"][1] == b"the text"
    assert calls["cuLibraryGetKernel"][2] == gpu.ENTRY.encode()
    assert calls["cuDevicePrimaryCtxRetain"][1] == 3 and calls["cuCtxPushCurrent_v2"] == (PRIMARY,)
    names = [name for name, _ in driver.calls]
    assert names[-2:] == ["cuCtxPopCurrent_v2", "cuDevicePrimaryCtxRelease_v2"]


@pytest.mark.parametrize("function", ["cuLibraryLoadData", "cuKernelGetFunction"])
def test_ptx_that_the_driver_refuses(function):
    """Its assembler's message is in the error, and the context is given back."""
    driver = FakeDriver(**{function: 218})
    with pytest.raises(launch.KernelUnavailable, match="INVALID_PTX .218. line 3: syntax error"):
        gpu.load(gpu.Driver(driver), "nonsense", 0)
    names = [name for name, _ in driver.calls]
    assert names.count("cuCtxPushCurrent_v2") == names.count("cuCtxPopCurrent_v2")
