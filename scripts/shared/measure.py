"""Times and memory of a measurement."""

import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax


def peak_memory() -> int:
    """Largest memory so far [byte]: of the device if it counts, else of this process."""
    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return int(stats["peak_bytes_in_use"])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class JaxProgram:
    """A function of arrays, compiled; runs return its results on the host's clock."""

    def __init__(self, function: Callable, *args: Any):
        """Compiles the function for its arguments."""
        self.args = args
        start = time.perf_counter()
        lowered = jax.jit(function).lower(*args)
        middle = time.perf_counter()
        self.compiled = lowered.compile()
        end = time.perf_counter()
        self.times = {"trace_s": middle - start, "compile_s": end - middle}

    def run(self) -> tuple[Any, float]:
        """Runs once; returns results and seconds."""
        start = time.perf_counter()
        result = jax.block_until_ready(self.compiled(*self.args))
        return result, time.perf_counter() - start


def use_cache(folder: str | None = None) -> None:
    """Points JAX's persistent compilation cache at a folder, by default at a new one."""
    folder = folder or tempfile.mkdtemp(prefix="benchmark-cache-")
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


_CHEAP = 5.0  # s


def repeat(run: Callable[[], tuple[Any, float]], repeats: int, until: float) -> tuple[Any, dict]:
    """Runs once to warm up and then repeatedly.

    Returns:
      Results of the last run, and all seconds; "seconds" holds the warm-up if there was no time for
      more.
    """
    result, first = run()
    seconds: list[float] = []
    # A cheap run is repeated once even if the time is over: a first one alone says little.
    while len(seconds) < repeats and (
        time.monotonic() + first < until or (not seconds and first < _CHEAP)
    ):
        result, taken = run()
        seconds.append(taken)
    kept = seconds or [first]
    return result, {
        "first_s": first,
        "seconds": kept,
        "median_s": statistics.median(kept),
        "warm": bool(seconds),
    }
