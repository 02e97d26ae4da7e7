"""SIGINT and SIGTERM: finish the step, save, stop; the second time at once."""

import concurrent.futures
import os
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, TypeVar

import jax

T = TypeVar("T")


def interruptible(function: Callable[..., T], *arguments: Any) -> T:
    """Calls a function of JAX and waits for its arrays; Ctrl-C ends the wait at once.

    The function goes on in a thread of its own until the process ends: what may be interrupted must
    have nothing to save.
    """
    future: concurrent.futures.Future[T] = concurrent.futures.Future()

    def work() -> None:
        try:
            future.set_result(jax.block_until_ready(function(*arguments)))
        except BaseException as error:  # the caller is to meet it, whatever it is
            future.set_exception(error)

    # Not of a pool: the interpreter waits for the threads of pools before it ends.
    threading.Thread(target=work, daemon=True).start()
    while not future.done():
        concurrent.futures.wait([future], timeout=0.2)
    return future.result()


class Stopped(Exception):
    """The user asked to stop, and nothing is left to save."""

    def __init__(self, signum: int):
        super().__init__(f"stopped by signal {signum}")
        self.signum = signum


class Interrupts:
    """Context in which the signals only set a flag.

    Simulations run in a worker thread: a signal's handler runs between two byte codes of the main
    thread, which a simulation may otherwise hold for minutes.
    """

    def __init__(self, notify: Callable[[str], None]):
        self.signum = 0
        self._notify = notify
        self._before: dict[int, Any] = {}
        self._worker = concurrent.futures.ThreadPoolExecutor(1)

    def __enter__(self) -> "Interrupts":
        """Installs the handlers where that is allowed, which is in the main thread."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._worker.shutdown()

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Runs a function and waits until its arrays are there."""
        return self.begin(function, *arguments)()

    def begin(self, function: Callable[..., T], *arguments: Any) -> Callable[[], T]:
        """Begins to run a function; returns what waits until its arrays are there."""
        if self.signum:
            raise Stopped(self.signum)
        future = self._worker.submit(lambda: jax.block_until_ready(function(*arguments)))

        def result() -> T:
            while not future.done():
                concurrent.futures.wait([future], timeout=0.2)
            return future.result()

        return result

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signum:
            os._exit(128 + number)  # every saved episode is complete; nothing needs tidying
        self.signum = number
        self._notify("stopping after this step; again to stop at once")
