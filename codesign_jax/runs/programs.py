"""The simulations of a command, each a program: the next one compiles while another one runs.

A search ends with tests that simulate another structure: smaller time steps, recorded states,
another bending law.  A simulation of few worlds leaves a core free now and then, and compiling
hardly uses a second one.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Self

RETEST = "re-test"
"""Name of the program of a final test at another accuracy than the search."""


class Programs:
    """The first program of a command, which its caller compiles, and later ones in their order."""

    def __init__(self, later: Mapping[str, Callable[[], object]] | None = None):
        """Compiles nothing yet.

        Args:
          later: What compiles each later program, by its name, in the order of their first use.
        """
        self._later = dict(later or {})
        self._ready = {name: threading.Event() for name in self._later}
        self.seconds = 0.0
        self._ended = False
        self._thread: threading.Thread | None = None

    @contextlib.contextmanager
    def first(self) -> Iterator[None]:
        """Adds the time of what compiles the first program, or a part of it, to `seconds`."""
        start = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - start

    def words(self, name: str = "") -> str:
        """What is said of a wait for a program, the first one by default; "" where it is ready."""
        if not name:
            return f"compiling 1 of {1 + len(self._later)}" if self._later else "compiling"
        if name not in self._later:
            return "compiling"
        if self._ready[name].is_set():
            return ""
        return f"compiling {2 + [*self._later].index(name)} of {1 + len(self._later)}"

    def begin(self) -> None:
        """Compiles the later programs in a thread, which ends with the process at the latest."""
        if self._later and self._thread is None:
            self._thread = threading.Thread(target=self._compile, daemon=True)
            self._thread.start()

    def wait(self, name: str, tell: Callable[[str], None]) -> None:
        """Waits until a later program is compiled, if it is one; Ctrl-C ends the wait.

        Args:
          name: Name of the program.
          tell: Is told `words` before the wait, and that there is none any more.
        """
        tell(self.words(name))
        if name in self._later:
            self.begin()
            while not self._ready[name].wait(0.2):
                pass
            tell("")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        """Begins no further program, and waits for the one that is being compiled.

        The interpreter's shutdown would take away what it uses.
        """
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            self.abandon()
        self._ended = True
        while self._thread is not None and self._thread.is_alive():
            self._thread.join(0.2)

    def abandon(self) -> None:
        """Begins no further program and waits for none: the process ends at once."""
        self._ended = True
        self._thread = None

    def _compile(self) -> None:
        for name, compile_program in self._later.items():
            if self._ended:
                return
            # Whoever needs the program meets the error again, and tells of it.
            with contextlib.suppress(Exception):
                compile_program()
            self._ready[name].set()
