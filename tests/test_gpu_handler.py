"""Launching kernels on NVIDIA GPUs, with a driver and an XLA of our own in place of a GPU."""

import ctypes
from ctypes import POINTER, c_char_p, c_int, c_uint, c_void_p

import pytest

from codesign_jax.compiler import ffi, gpu, launch
from codesign_jax.compiler.values import OUTPUT, Array, Layout
from tests.helpers import call_frames

KERNEL, CONTEXT, PRIMARY = 0xCAFE, 0xC0, 0xC1
NAMES = {1: b"CUDA_ERROR_INVALID_VALUE", 218: b"CUDA_ERROR_INVALID_PTX"}
LAYOUT = Layout(
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
        self.calls, self.results = [], results
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
    loaded = gpu.prepare("fake", LAYOUT, KERNEL, gpu.Driver(fake))

    def use(driver):
        table = loaded.numbers("fake_table", 1 + len(gpu.CALLS))
        for k, name in enumerate(gpu.CALLS):
            table[1 + k] = gpu.Driver(driver).address(name)
        return driver

    return loaded.function("fake"), use, fake


def test_launch(prepared):
    """Grid, block, stream and the address of every array's first block, in the stream's context."""
    handler, use, _ = prepared
    driver, xla = use(FakeDriver()), call_frames.Xla()
    for blocks in (1, 7):
        inputs, outputs = call_frames.arrays(LAYOUT, blocks)
        assert xla.call(handler, inputs, outputs) is None
        addresses = [a.ctypes.data for a in (*inputs, *outputs)]
        names, arguments = zip(*driver.calls, strict=True)
        assert names == ("cuStreamGetCtx", "cuCtxPushCurrent_v2", "cuLaunchKernel") + (
            "cuCtxPopCurrent_v2",
        )
        assert arguments[0][0] == call_frames.STREAM and arguments[1] == (CONTEXT,)
        assert arguments[2] == (
            *(KERNEL, blocks, 1, 1, 32, 1, 1, 0, call_frames.STREAM, addresses, None),
        )
        driver.calls.clear()
    inputs, outputs = call_frames.arrays(LAYOUT, 0)
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
    driver, xla = use(FakeDriver(**{function: result})), call_frames.Xla()
    assert xla.call(handler, *call_frames.arrays(LAYOUT, 2)) == (ffi.INTERNAL, message)
    names = [name for name, _ in driver.calls]
    assert ("cuLaunchKernel" in names) == ("cuCtxPopCurrent_v2" in names)
    assert "cuLaunchKernel" not in names or function in ("cuLaunchKernel", "cuCtxPopCurrent_v2")


def test_errors_of_xla(prepared):
    """No stream: XLA's own error is handed back.  Arrays of another kind are not launched on."""
    handler, use, _ = prepared
    driver, xla = use(FakeDriver()), call_frames.Xla(stream_error=1)
    xla.errors.append((9, "no stream"))
    inputs, outputs = call_frames.arrays(LAYOUT, 2)
    assert xla.call(handler, inputs, outputs) == (9, "no stream")
    for wrong in ([inputs[0], inputs[0]], [inputs[0][:, :1], inputs[1]], inputs[:1]):
        code, message = call_frames.Xla().call(handler, wrong, outputs)
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
