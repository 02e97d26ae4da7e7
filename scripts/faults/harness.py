"""Runs campaigns in worker processes, each under a time limit, and stores what they count."""

import contextlib
import fcntl
import json
import os
import queue
import select
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scripts.faults import finished, shim
from scripts.faults.campaigns import Campaign
from scripts.faults.store import Part, Result, Store, gather

_PREPARING = 1800.0
"""Time to make the finished runs with cold caches on a busy machine [s]."""
_ENDING = 20.0
_SILENCE = 10.0
MOST_CASES = 400
"""Cases after which a worker is replaced, as its memory grows with what faults leave in it."""


class Ended(Exception):
    """A worker ended or hung; the reason is its only argument."""


class Worker:
    """A process of `worker`, with which all end that it starts."""

    def __init__(self, folder: Path, library: Path, environment: dict[str, str]):
        """Starts it.

        Args:
          folder: Folder of finished runs; caches of programs are beside it.
          library: The preloaded library.
          environment: Further variables.
        """
        inherited = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "CODESIGN_"))}
        own = {"XDG_CACHE_HOME": str(folder.parent / "cache"), "OPENBLAS_NUM_THREADS": "1"}
        # A cache of XLA's for GPUs, whose path would be a part of each program's key: programs
        # would not be found in a copy of their folder.
        own["JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES"] = "none"
        # Forks and new interpreters begin in other folders than this one.
        own["PYTHONPATH"] = str(Path(__file__).parents[2])
        program = [sys.executable, "-m", "scripts.faults.worker"]
        program += ["--folder", str(folder), "--library", str(library)]
        with (folder / f"worker-{threading.get_ident()}.log").open("ab") as log:
            self._process = subprocess.Popen(
                program,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,  # Ctrl-C at the terminal is not for it
                env=inherited | own | shim.environment(library) | environment,
            )
        self.cases, self._rest = 0, b""

    def send(self, request: dict[str, Any]) -> None:
        """Sends a request."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()

    def receive(self, limit: float) -> dict[str, Any]:
        """Returns the next answer.

        Raises:
          Ended: If there is none within `limit` seconds, or the process ended.
        """
        assert self._process.stdout is not None
        until = time.monotonic() + limit
        while b"\n" not in self._rest:
            ready, _, _ = select.select([self._process.stdout], [], [], until - time.monotonic())
            if not ready:
                raise Ended("hung")
            more = os.read(self._process.stdout.fileno(), 1 << 16)
            if not more:
                raise Ended(f"died: exit status {self._process.wait()}")
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\n")
        return json.loads(line)

    def close(self, *, kill: bool = False) -> None:
        """Ends the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        if not kill:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_ENDING)
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


class Harness:
    """Campaigns, the store of their results, and the workers that run them."""

    def __init__(self, store: Store, work: Path, tell: Callable[[str], None]):
        """Takes the store, a folder for caches and finished runs, and what to tell."""
        self._store, self._tell, self._lock = store, tell, threading.Lock()
        self._folder = work.absolute() / finished.code_digest()[:12]
        self._library = shim.build(work)
        self._left: queue.Queue[tuple[Campaign, range]] = queue.Queue()
        self.stop, self._said = threading.Event(), 0.0

    def run(self, campaigns: list[Campaign], counts: dict[str, int], workers: int) -> None:
        """Runs what is left of the campaigns; `stop` ends it after the parts that have begun.

        Args:
          campaigns: The campaigns.
          counts: Cases of each.
          workers: Processes at a time.
        """
        with (self._folder.parent / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise SystemExit(
                    f"{self._folder.parent} is in use: another --work, please"
                ) from None
            self._run(campaigns, counts, workers)

    def _run(self, campaigns: list[Campaign], counts: dict[str, int], workers: int) -> None:
        self._prepare()
        for campaign in campaigns:
            for numbers in self._store.left(campaign.name, counts[campaign.name], campaign.size):
                self._left.put((campaign, numbers))
        threads = [threading.Thread(target=self._work) for _ in range(workers)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _prepare(self) -> None:
        """Makes the finished runs of this code, and with them the caches of programs."""
        for other in self._folder.parent.glob("*"):
            if other.is_dir() and other.name not in (self._folder.name, "cache"):
                shutil.rmtree(other, ignore_errors=True)  # of other code
        if (self._folder / "modules.json").exists():
            for left in self._folder.glob("case-*"):
                shutil.rmtree(left, ignore_errors=True)  # of a start that was killed
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        self._tell("making the runs to compare with, which compiles once")
        worker = Worker(self._folder, self._library, {})
        try:
            worker.send({"prepare": True})
            worker.receive(_PREPARING)
        finally:
            worker.close()

    def _work(self) -> None:
        """Runs parts until none is left; a worker of its own belongs to this thread."""
        worker: Worker | None = None
        kept: tuple[tuple[str, str], ...] = ()
        while not self.stop.is_set():
            try:
                campaign, numbers = self._left.get_nowait()
            except queue.Empty:
                break
            old = worker is not None and worker.cases > MOST_CASES and campaign.size == 1
            if worker is not None and (campaign.alone or old or kept != campaign.environment):
                worker.close()
                worker = None
            if worker is None:
                kept = campaign.environment
                worker = Worker(self._folder, self._library, dict(kept))
            if not self._part(worker, campaign, numbers):
                worker.close(kill=True)
                worker = None
            elif campaign.alone:
                worker.close()
                worker = None
        if worker is not None:
            worker.close()

    def _part(self, worker: Worker, campaign: Campaign, numbers: range) -> bool:
        """Runs cases and stores them; False if the worker is gone."""
        begin, results, alive = time.monotonic(), dict[int, Result](), True
        worker.send({"campaign": campaign.name, "first": numbers.start, "stop": numbers.stop})
        for number in numbers:
            try:
                answer = worker.receive(campaign.limit)
                worker.cases += 1
                fields = {k: answer[k] for k in Result._fields}
                results[number] = Result(**fields)
            except Ended as why:
                word, _, detail = str(why).partition(": ")
                results[number], alive = Result(word, detail), False
                rest = range(number + 1, numbers.stop)
                if rest:
                    self._left.put((campaign, rest))
                numbers = range(numbers.start, number + 1)
                break
        part = gather(campaign.name, numbers, results, campaign.good, time.monotonic() - begin)
        with self._lock:
            self._store.add(part)
            self._say(campaign, part)
        return alive

    def _say(self, campaign: Campaign, part: Part) -> None:
        """Tells of a part that broke a promise, and every few seconds of how far it is."""
        if not part.bad and time.monotonic() - self._said < _SILENCE:
            return
        self._said = time.monotonic()
        now = self._store.summary(campaign.name)
        words = ", ".join(f"{count} {word}" for word, count in now["counts"].items())
        bad = "".join(
            f"\n  BROKEN {number}: {word}: {d[:200]} [...] {d[-300:]}"
            for number, word, d in part.bad
        )
        span = f"{part.first}" if part.stop == part.first + 1 else f"{part.first}-{part.stop - 1}"
        self._tell(f"{campaign.name} {span} ({part.seconds:.1f} s); in all {words}{bad}")
