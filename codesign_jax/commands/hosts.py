"""`codesign optimize --seeds ... --distributed`: several hosts share the seeds of one command.

JAX's distributed runtime tells each process which of how many it is, and lets all wait for the last
one.  The runs of a host's own seeds are simulated by a process of their own, on that host's devices
alone: orbax would not save the arrays of any host but the first one.  Files are the only other
interface, so the folder must be one that all hosts see.
"""

import dataclasses
import multiprocessing
import re
import signal
import sys
from collections.abc import Callable

import jax

from codesign_jax.commands import common, status
from codesign_jax.commands.flags import Optimize
from codesign_jax.runs.progress import Busy
from codesign_jax.scene.schema import InputError
from codesign_jax.terminal import Console

WAIT = 7 * 24 * 3600
"""Longest time that a process waits for the others' runs [s]."""


def check(text: str) -> tuple[str, int, int] | None:
    """Reads "ADDRESS:PORT,PROCESSES,INDEX"; None for "auto"."""
    if text == "auto":
        return None
    match = re.fullmatch(r"([^,\s]+:[0-9]{1,5}),([0-9]{1,5}),([0-9]{1,5})", text)
    if match is None or not int(match[3]) < int(match[2]):
        raise InputError(
            [
                f"--distributed {text!r} must be auto or ADDRESS:PORT,PROCESSES,INDEX, such as "
                "node0:1234,2,0 on the first of two hosts"
            ]
        )
    return match[1], int(match[2]), int(match[3])


def join(text: str) -> tuple[int, int]:
    """Meets the others, before anything of JAX is used: which of how many processes this is."""
    membership = check(text)
    address, count, index = membership or (None, None, None)
    jax.config.update("jax_platforms", "cpu")  # this process leaves the GPUs to the one that runs
    others = "the other processes"
    if count is not None:
        others = f"{common.counted(count - 1, 'other process', 'es')} at {address}"
    try:
        with Busy(Console(), f"waiting for {others} of --distributed {text}"):
            jax.distributed.initialize(address, count, index, shutdown_timeout_seconds=WAIT)
    except (RuntimeError, ValueError) as error:
        raise InputError([f"--distributed {text}: {error}"]) from error
    return jax.process_index(), jax.process_count()


def run(options: Optimize) -> tuple[int, int]:
    """Runs this host's seeds and waits for all hosts'; the exit status and this host's index."""
    chosen = common.parse_seeds(options.seeds or "")
    index, count = join(options.distributed or "")
    mine = ",".join(map(str, chosen[index::count]))
    code = 0
    if mine:
        host_options = dataclasses.replace(options, distributed=None, seeds=mine)
        code = in_a_process(host_options.run)
    if code < 128:  # not stopped by a signal
        with Busy(Console(), f"waiting for the runs of {count} processes"):
            jax.distributed.shutdown()
    return code, index


def in_a_process(function: Callable[[], int]) -> int:
    """The exit status of a function in a process that knows nothing of other hosts."""
    process = multiprocessing.get_context("spawn").Process(
        target=_child, args=(function, [*sys.argv])
    )
    # A terminal sends Ctrl-C to both; what ends jobs may know this process only.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    process.start()
    earlier = signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    process.join()
    signal.signal(signal.SIGINT, before)
    signal.signal(signal.SIGTERM, earlier)
    code = process.exitcode
    return 1 if code is None else 128 - code if code < 0 else code


def _child(function: Callable[[], int], arguments: list[str]) -> None:
    sys.argv = arguments
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(status.of(function))
