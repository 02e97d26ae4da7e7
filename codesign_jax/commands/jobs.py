"""`codesign optimize --seeds ... --jobs N`: each run a process of its own, on SLURM or here.

submitit starts them: as a SLURM array where there is SLURM, else as local processes.  Files are the
only interface: a run is read back from its folder, and the same command resumes those that did not
finish.
"""

import contextlib
import dataclasses
import os
import secrets
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from codesign_jax import codesign, runs
from codesign_jax.commands import common, slurm, status
from codesign_jax.runs import RunResult, Settings
from codesign_jax.runs.directory import EVENTS
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError

if TYPE_CHECKING:
    from codesign_jax.cli import Optimize

FOLDER = "jobs"
"""Folder beside the run folders, with a folder of submitit's files and logs for each start."""
CONTROLLERS = "controllers.log"
"""File there with what submitit's own processes complain about."""
POLL_SECONDS = 0.5
MINUTES = 7 * 24 * 60
"""Time limit of a local process where none is given; submitit's own is five minutes."""


def executor(options: "Optimize", folder: Path) -> Any:
    """Executor of submitit with the command line's parameters.

    Args:
      options: The command line; `job_set` has parameters of submitit, such as slurm_partition.
      folder: Folder of submitit's files, see `private_folder`.

    Raises:
      InputError: If submitit is missing, or a parameter is none of its own.
    """
    submitit = _submitit()
    given = job_parameters([*chain.from_iterable(options.job_set)])
    kind, asked = given.pop("cluster", None), slurm.submitit_parameters(given)
    try:
        made = submitit.AutoExecutor(folder=folder, cluster=kind)  # type: ignore[arg-type]
        ours = {"name": "codesign", "slurm_array_parallelism": options.jobs}
        if made.cluster != "slurm":
            ours["timeout_min"] = MINUTES
        made.update_parameters(**ours | asked)  # type: ignore[arg-type]
    # submitit asserts that a parameter's type is right.
    except (AssertionError, NameError, TypeError, ValueError, RuntimeError) as error:
        raise InputError([f"--job-set: {error}"]) from error
    return made


def where(made: Any, options: "Optimize") -> str:
    """Where an executor starts the runs, and which parameters are of no use there, in words."""
    given = job_parameters([*chain.from_iterable(options.job_set)])
    idle = [name for name in given if name.startswith("slurm_") and made.cluster != "slurm"]
    reason = "there is no SLURM here" if "cluster" not in given else "that is not SLURM"
    return made.cluster + (f"; not used, as {reason}: {', '.join(idle)}" if idle else "")


def plan(options: "Optimize") -> str:
    """Says where the runs would start; nothing is started or left behind.

    Raises:
      InputError: See `executor`.
    """
    with tempfile.TemporaryDirectory() as folder:
        return where(executor(options, Path(folder)), options)


@contextlib.contextmanager
def private_folder(runs_folder: Path) -> Iterator[Path]:
    """Makes a folder for submitit's files that was not there before, and that is the user's alone.

    submitit reads results by pickle, which does whatever the file says: so no file that lay there
    before may be taken for one.

    Args:
      runs_folder: Folder of the runs; made if it is missing.

    Yields:
      The folder; it and those made for it are removed if the block raises InputError.
    """
    name = f"{time.strftime('%Y-%m-%dT%H-%M-%S')}-{secrets.token_hex(4)}"
    folder = runs_folder / FOLDER / name
    missing = [path for path in [folder, *folder.parents] if not path.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700)  # fails if there is something of that name
    try:
        yield folder
    except InputError:
        shutil.rmtree(missing[-1])
        raise


def _submitit() -> Any:
    """The module, without its configuration of logging, which closes every handler there is.

    Raises:
      InputError: If it is missing.
    """
    ours = "SUBMITIT_LOG_LEVEL" not in os.environ
    os.environ.setdefault("SUBMITIT_LOG_LEVEL", "NOCONFIG")
    try:
        import submitit
    except ImportError as error:
        message = "--jobs needs submitit: pip install '.[cluster]' in the checkout"
        raise InputError([message]) from error
    finally:
        if ours:  # jobs log as submitit does by default
            del os.environ["SUBMITIT_LOG_LEVEL"]
    return submitit


def job_parameters(pairs: Sequence[str]) -> dict[str, bool | int | float | str]:
    """Reads KEY=VALUE pairs; numbers, true and false become what submitit wants them to be.

    Raises:
      InputError: If a pair has no key or no value.
    """
    found: dict[str, bool | int | float | str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals and value):
            raise InputError([f"--job-set {pair!r} must be KEY=VALUE"])
        found[key] = _value(value)
    return found


def _value(text: str) -> bool | int | float | str:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            if str(kind(text)) == text:  # an account such as 007 stays a name
                return kind(text)
        except ValueError:
            pass
    return text


def one(options: "Optimize", settings: Settings, folder: Path, arguments: list[str]) -> int:
    """Runs one of the runs in the process of a job; returns the command's exit status.

    Args:
      options: The command line for all of them.
      settings: Settings of the run.
      folder: Its run folder.
      arguments: Command line to note in the run folder.
    """
    sys.argv = arguments
    slurm.resume_before_the_limit(folder)
    own = {"seeds": None, "jobs": None, "job_set": (), "out": folder, "seed": settings.seed}
    own |= {"schedule": settings.schedule, "first": settings.first}
    fresh = options.fresh and not slurm.restarted()
    try:
        return status.of(dataclasses.replace(options, **own, fresh=fresh).run)  # type: ignore[arg-type]
    except Exception as error:  # whatever it is, the command that started the jobs tells it
        traceback.print_exc()
        print(f"error: {type(error).__name__}: {error}", file=sys.stderr)
        return 1


def run(
    options: "Optimize", scene: Scene, every: Mapping[Path, Settings], console: Console
) -> dict[Path, RunResult | None]:
    """Runs each of several runs as a job and reads the results from the run folders.

    Args:
      options: The command line.
      scene: The scene, for the rule by which failed trials count.
      every: Settings of each run by its folder.
      console: Told when a run ends.

    Returns:
      Each run by its folder; None for one that did not finish.

    Raises:
      InputError: See `executor`; or if SLURM does not take the jobs.
      KeyboardInterrupt: When all jobs were cancelled.
    """
    calls = {
        folder: (one, options, settings, folder.absolute(), sys.argv)
        for folder, settings in every.items()
    }
    called = runs.run_names(every)
    with private_folder(options.out or Path("runs")) as own:
        made = executor(options, own)
        console.print(
            f"{len(calls)} runs, {options.jobs} at a time, on {where(made, options)}; logs: "
            f"{made.folder}",
            markup=False,
        )
        if made.cluster == "slurm":
            place = slurm.JobArray(made, console)
        else:
            place = Processes(made, options.jobs or 1)
        place.start(calls)
    results: dict[Path, RunResult | None] = {}
    try:
        with Busy(console, _state(results, every)) as busy:
            while len(results) < len(every):
                for folder, job, state in place.ended():
                    problem = why(job, state)
                    results[folder] = None if problem else read(scene, folder)
                    console.print(f"{called[folder]}: {problem or 'done'}", markup=False)
                busy.say(_state(results, every))
                time.sleep(POLL_SECONDS)
    except KeyboardInterrupt:
        place.cancel()
        console.print("stopped: the jobs are cancelled; the same command resumes")
        raise
    return {folder: results[folder] for folder in every}


def _state(results: Mapping[Path, RunResult | None], every: Iterable[Path]) -> str:
    """How many runs have ended, and how far the others are, by their logs."""
    events = [_last_event(folder / EVENTS) for folder in every if folder not in results]
    busy = [event for event in events if event]
    text = f"{len(results)} of {len(results) + len(events)} runs ended, {len(busy)} begun"
    return f"{text}; the last words of one: {max(busy)[1]}" if busy else text


def _last_event(log: Path) -> tuple[str, str] | None:
    """Time and first words of a log's last line; None if there is none."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 1000))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return None
    when, _, words = (lines or [""])[-1].partition(" ")
    return when, words.split("  ")[0][:60]


class Processes:
    """Jobs as processes of this machine, so many at a time."""

    def __init__(self, made: Any, most: int):
        """Takes submitit's executor and how many may run at once."""
        self._made, self._most = made, most
        self._waiting: dict[Path, tuple[Any, ...]] = {}
        self._running: dict[Path, Any] = {}

    def start(self, calls: Mapping[Path, tuple[Any, ...]]) -> None:
        """Takes a call for each run folder; each starts when there is room."""
        self._waiting = dict(calls)

    def ended(self) -> Iterator[tuple[Path, Any, str]]:
        """Folder and job of each run that has ended since; "" or why it left no result."""
        while self._waiting and len(self._running) < self._most:
            folder = next(iter(self._waiting))
            # submitit's controller of a job tells every Ctrl-C with a traceback.
            with _errors_to(Path(self._made.folder) / CONTROLLERS):
                self._running[folder] = self._made.submit(*self._waiting.pop(folder))
        for folder in [f for f, job in self._running.items() if job.done()]:
            job = self._running.pop(folder)
            yield folder, job, "" if job.paths.result_pickle.exists() else "killed"

    def cancel(self) -> None:
        """Ends what runs, and starts nothing more."""
        self._waiting = {}
        for job in self._running.values():
            job.cancel()


@contextlib.contextmanager
def _errors_to(path: Path) -> Iterator[None]:
    """Lets processes that are started meanwhile write their errors to the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    own = os.dup(2)
    with path.open("ab") as file:
        os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(own, 2)
        os.close(own)


def why(job: Any, state: str) -> str:
    """Why a job that has ended did not succeed, in words; nothing if it did.

    Args:
      job: submitit's job.
      state: What ended a job that left no result, else nothing.
    """
    if state:
        return f"failed: {state}; log: {job.paths.stderr}"
    code = 1 if job.exception() is not None else job.result()
    if code == 0:
        return ""
    if code > 128:
        return f"stopped by {signal.Signals(code - 128).name}; the same command resumes"
    return f"failed: {_last_words(job.paths.stderr)}; log: {job.paths.stderr}"


def _last_words(log: Path) -> str:
    """The last error in a log, or its last line."""
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    lines = [line.strip() for line in lines if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or ["without a word"])[-1].removeprefix("error: ")


def read(scene: Scene, folder: Path) -> RunResult | None:
    """The run in a folder as it is; None if it has no checkpoint, or every trial failed."""
    try:
        record = runs.load_record(folder, tell=common.warn)
    except InputError as error:
        common.warn(str(error))
        return None
    if record is None or record.failed_status() is not None:
        return None
    test = None if record.test is None else codesign.summarize_test(scene, record.test)
    return RunResult(record, test, 0)
