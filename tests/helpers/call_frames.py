"""XLA's side of its foreign function interface, so that handlers can be called without XLA."""

import ctypes
import threading
from ctypes import c_int64, c_void_p

import numpy as np

from codesign_jax.compiler import ffi

FUNCTION = ctypes.CFUNCTYPE(c_void_p, c_void_p)
STREAM = 0x57EA


class Xla:
    """Functions that handlers call, which note what they were asked for.

    Error k is the pointer k + 1; `tasks` have not been run yet, `scheduled` were asked for.
    """

    def __init__(self, threads=1, pool="late", stream_error=0):
        """No pool with 0 threads; its tasks run "at once", "late", in "threads", or never."""
        self.errors, self.destroyed, self.tasks, self.scheduled = [], [], [], 0
        self.threads, self.pool, self.stream_error = threads, pool, stream_error
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

    def call(self, address, inputs, outputs, **changes):
        """Calls a handler on NumPy arrays; its error's code and message, or None."""
        frame, _keep = self.frame(inputs, outputs, **changes)
        pointer = FUNCTION(address)(ctypes.addressof(frame))
        return self.errors[pointer - 1] if pointer else None

    def frame(self, inputs, outputs, **changes):
        """A call frame, and what it points to."""
        keep = []

        def arguments(arrays):
            buffers = [self._buffer(a, keep) for a in arrays]
            pointers = (c_void_p * len(arrays))(*(ctypes.addressof(b) for b in buffers))
            keep.extend([*buffers, pointers])
            return ffi.Arguments(
                struct_size=ffi.size(ffi.Arguments),
                size=len(arrays),
                values=ctypes.addressof(pointers),
            )

        fields = dict(
            struct_size=ffi.size(ffi.CallFrame),
            api=ctypes.addressof(self.api),
            stage=3,
            args=arguments(inputs),
            rets=arguments(outputs),
        )
        return ffi.CallFrame(**fields | changes), keep

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
        given = ffi.ErrorCreate.from_address(record)
        self.errors.append((given.errc, ctypes.string_at(given.message).decode()))
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
        given = ffi.NumThreads.from_address(record)
        c_int64.from_address(given.num_threads).value = self.threads
        return None

    def _schedule(self, record):
        given = ffi.Schedule.from_address(record)
        function, data = ctypes.CFUNCTYPE(None, c_void_p)(given.task), given.data
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
    found = {"input": [], "output": []}
    for array in layout.arrays:
        if array.role in found:
            shape = (1 if array.shared else blocks, *array.shape)
            values = rng.standard_normal(shape) if array.role == "input" else np.zeros(shape)
            found[array.role].append(values.astype(array.dtype))
    return found["input"], found["output"]
