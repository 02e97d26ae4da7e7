"""`codesign optimize --seeds ... --jobs N`: each run a process of its own, on SLURM or here.

submitit starts them: as a SLURM array where there is SLURM, else as local processes.  Files are the
only interface: a run is read back from its folder, and the same command resumes those that did not
finish.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from codesign_jax import codesign, runs
from codesign_jax.runs import RunResult
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import SceneError

if TYPE_CHECKING:
    from codesign_jax.cli import Optimize

FOLDER = "jobs"
"""Folder of submitit's files and logs, beside the run folders."""
POLL_SECONDS = 0.5
MINUTES = 7 * 24 * 60
"""Time limit of a job where none is given; submitit's own for local processes is five minutes."""


def executor(options: "Optimize", folder: Path) -> Any:
    """Executor of submitit with the command line's parameters.

    Args:
      options: The command line; `job_set` has parameters of submitit, such as slurm_partition.
      folder: Folder of the runs.

    Raises:
      SceneError: If submitit is missing, or a parameter is none of its own.
    """
    submitit = _submitit()
    given = parameters([*chain.from_iterable(options.job_set)])
    kind = given.pop("cluster", None)
    try:
        made = submitit.AutoExecutor(folder=folder / FOLDER, cluster=kind)  # type: ignore[arg-type]
        made.update_parameters(
            **{"name": "codesign", "timeout_min": MINUTES, "slurm_array_parallelism": options.jobs}
            | given  # type: ignore[arg-type]
        )
    except (NameError, TypeError, ValueError, RuntimeError) as error:
        raise SceneError([f"--job-set: {error}"]) from error
    return made


def _submitit() -> Any:
    """The module, without its configuration of logging, which closes every handler there is.

    Raises:
      SceneError: If it is missing.
    """
    ours = "SUBMITIT_LOG_LEVEL" not in os.environ
    os.environ.setdefault("SUBMITIT_LOG_LEVEL", "NOCONFIG")
    try:
        import submitit
    except ImportError as error:
        raise SceneError(["--jobs needs submitit: pip install 'codesign-jax[cluster]'"]) from error
    finally:
        if ours:  # jobs log as submitit does by default
            del os.environ["SUBMITIT_LOG_LEVEL"]
    return submitit


def parameters(pairs: Sequence[str]) -> dict[str, int | str]:
    """Reads KEY=VALUE pairs; whole numbers become int, as submitit wants them.

    Raises:
      SceneError: If a pair has no key or no value.
    """
    found: dict[str, int | str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals and value):
            raise SceneError([f"--job-set {pair!r} must be KEY=VALUE"])
        found[key] = int(value) if value.isdigit() else value
    return found


def one(options: "Optimize", seed: int, folder: Path, arguments: list[str]) -> int:
    """Runs one seed in the process of a job; returns the command's exit status.

    Args:
      options: The command line for all seeds.
      seed: The seed.
      folder: Its run folder.
      arguments: Command line to note in the run folder.
    """
    from codesign_jax.commands import optimize

    sys.argv = arguments
    return optimize.main(
        dataclasses.replace(options, seeds=None, jobs=None, job_set=(), seed=seed, out=folder)
    )


def run(
    options: "Optimize", scene: Scene, folders: dict[int, Path], console: Console
) -> dict[int, RunResult | None]:
    """Runs every seed as a job and reads the results from the run folders.

    Args:
      options: The command line.
      scene: The scene, for the rule by which failed trials count.
      folders: Run folder of each seed.
      console: Told when a run ends.

    Returns:
      Each run by its seed; None for one that did not finish.
    """
    made = executor(options, next(iter(folders.values())).parent)
    calls = [(seed, folder.absolute()) for seed, folder in folders.items()]
    console.print(
        f"{len(calls)} runs, {options.jobs} at a time, on {made.cluster}; logs: {made.folder}",
        markup=False,
    )
    if made.cluster == "slurm":
        with made.batch():  # one array, which SLURM keeps within the number at a time
            started = {s: made.submit(one, options, s, f, sys.argv) for s, f in calls}
        return _collect(started, [], None, options, scene, folders, console)
    waiting = list(calls)

    def start(seed: int, folder: Path) -> Any:
        return made.submit(one, options, seed, folder, sys.argv)

    return _collect({}, waiting, start, options, scene, folders, console)


def _collect(running, waiting, start, options, scene, folders, console):
    """Starts what waits as places become free, and reads each run when its job ends."""
    results: dict[int, RunResult | None] = {}
    try:
        while running or waiting:
            while waiting and len(running) < options.jobs:
                seed, folder = waiting.pop(0)
                running[seed] = start(seed, folder)
            for seed in [s for s, job in running.items() if job.done()]:
                job = running.pop(seed)
                results[seed] = read(scene, folders[seed]) if _succeeded(job) else None
                state = "done" if results[seed] else f"failed, see {job.paths.stderr}"
                console.print(f"seed {seed}: {state}", markup=False)
            time.sleep(POLL_SECONDS)
    except KeyboardInterrupt:
        for job in running.values():
            job.cancel()
        raise
    return {seed: results[seed] for seed in folders}


def _succeeded(job: Any) -> bool:
    return job.exception() is None and job.result() == 0


def read(scene: Scene, folder: Path) -> RunResult | None:
    """The run in a folder as it is; None if it has no checkpoint."""
    record = runs.load_record(folder)
    if record is None:
        return None
    test = None if record.test is None else codesign.summarize_test(scene, record.test)
    return RunResult(record, test, 0)
