"""Runs as one array of SLURM jobs: how they are asked for, and what SLURM says of them.

submitit writes the array's script and starts the function in each job.  What became of a job is
read from its result file and from `squeue`: submitit asks `sacct`, which many small clusters do
not have, and would wait for ever for a job that was cancelled.
"""

import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from codesign_jax.runs import checkpoint
from codesign_jax.scene.schema import InputError

QUEUE_SECONDS = 10.0
"""Time between two calls of `squeue`, which the cluster's controller has to answer."""
RESULT_SECONDS = 30.0
"""How long the result of a job that has ended may take through a shared file system."""

LIVE = {
    *("PENDING", "CONFIGURING", "RUNNING", "COMPLETING", "SUSPENDED", "STOPPED", "SIGNALING"),
    *("REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "RESIZING", "STAGE_OUT", "SPECIAL_EXIT"),
    *("RESV_DEL_HOLD", "REVOKED"),
}
"""States of a job that may still end by itself."""
NORMAL = {"None", "Priority", "Resources", "JobArrayTaskLimit", "BeginTime"}
"""Reasons for which jobs wait in any queue."""


class JobState(NamedTuple):
    """State of a job in SLURM's words, and why it waits or ended."""

    name: str
    reason: str = "None"


def submitit_parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of submitit from those of `--job-set`, in the types that it wants.

    Args:
      given: Texts and numbers of the command line.  Commands before the run (`slurm_setup`) and
        after it are one line of shell, arguments of srun are as in a shell, and what else sbatch
        takes (`slurm_additional_parameters`) is such as "reservation=course,hint=compute_bound".

    Raises:
      InputError: If a run would be more than one process.
    """
    many = [k for k in given if k.removeprefix("slurm_") in ("nodes", "tasks_per_node")]
    if any(given[name] != 1 for name in many):
        raise InputError([f"--job-set {many[0]}: a run is one process on one node"])
    found = dict(given)
    for name in {"slurm_setup", "slurm_teardown"} & {*given}:
        found[name] = [str(given[name])]
    # srun does not take over sbatch's number of cores, and may bind the run to one of them.
    cores = given.get("cpus_per_task", given.get("slurm_cpus_per_task"))
    bound = [] if cores is None else [f"--cpus-per-task={cores}"]
    found["slurm_srun_args"] = [*bound, *shlex.split(str(given.get("slurm_srun_args", "")))]
    further = str(given.get("slurm_additional_parameters", ""))
    pairs = (pair.partition("=") for pair in further.split(",") if pair)
    # A run resumes, so a job whose node fails or that makes room for others comes back.
    found["slurm_additional_parameters"] = {"requeue": True} | {
        key: value if equals else True for key, equals, value in pairs
    }
    return found


class JobArray:
    """Jobs of one array."""

    def __init__(self, made: Any, console: Console):
        """Takes submitit's executor, and the console that is told how the queue moves."""
        # No limit of our own: the partition's, and not submitit's five minutes.
        made.parameters.setdefault("time", None)
        self._made, self._console = made, console
        self._jobs: dict[Path, Any] = {}
        self._asked, self._said = float("-inf"), ""
        self._states: dict[str, JobState] = {}
        self._ended: dict[Path, float] = {}

    def start(self, calls: Mapping[Path, tuple[Any, ...]]) -> None:
        """Queues a call for each run folder.

        Raises:
          InputError: With SLURM's words, if it does not take them.
        """
        try:
            with self._made.batch():  # SLURM keeps an array within its number at a time
                self._jobs = {folder: self._made.submit(*call) for folder, call in calls.items()}
        except (OSError, RuntimeError) as error:
            words = str(error).strip().splitlines()[-1:] or ["without a word"]
            problem = f"SLURM does not take the jobs: {words[0].removeprefix('sbatch: error: ')}"
            advice = "to use this machine instead: --job-set cluster=local"
            raise InputError([problem, advice]) from error
        array = next(iter(self._jobs.values())).job_id.split("_")[0]
        self._console.print(f"SLURM job {array}; to look at it: squeue --jobs {array}")

    def ended(self) -> Iterator[tuple[Path, Any, str]]:
        """Seed and job of each run that has ended since, and SLURM's state if it left no result."""
        self._look()
        for folder, job in [*self._jobs.items()]:
            state = ""
            if not job.paths.result_pickle.exists():
                state = self._lost(folder, job.job_id)
                if not state:
                    continue
            del self._jobs[folder]
            yield folder, job, state

    def cancel(self) -> None:
        """Cancels what is left."""
        ids = [job.job_id for job in self._jobs.values()]
        if ids:
            subprocess.run(["scancel", *ids], check=False)

    def _look(self) -> None:
        """Asks the queue from time to time, and says when it has moved."""
        now = time.monotonic()
        if now - self._asked < QUEUE_SECONDS:
            return
        self._asked = now
        found = states(job.job_id for job in self._jobs.values())
        if found is None:
            return
        self._states = found
        for folder, job in self._jobs.items():
            state = found.get(job.job_id)
            if state is not None and state.name in LIVE:
                self._ended.pop(folder, None)
            else:
                self._ended.setdefault(folder, now)
        words = summary(found.values())
        if words and words != self._said:
            self._console.print(f"SLURM: {words}", markup=False)
            self._said = words

    def _lost(self, folder: Path, job_id: str) -> str:
        """State of a job that ended without a result, or nothing."""
        since = self._ended.get(folder)
        if since is None or time.monotonic() - since < RESULT_SECONDS:
            return ""
        state = self._states.get(job_id, JobState("unknown: it has left the queue"))
        # A job that was cancelled as it waited still has the reason for that.
        return state.name if state.reason in NORMAL else f"{state.name} ({state.reason})"


def states(job_ids: Iterable[str]) -> dict[str, JobState] | None:
    """States of jobs by their id; those that SLURM has forgotten are missing.

    Args:
      job_ids: Ids such as 17, or 17_0 for the first job of an array.

    Returns:
      None if SLURM does not answer, so that nothing is known.
    """
    ids = [*job_ids]
    arrays = ",".join(sorted({job_id.split("_")[0] for job_id in ids}))
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%i|%T|%r"]
    try:
        asked = subprocess.run(
            [*command, "--jobs", arrays], capture_output=True, text=True, timeout=60
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    if asked.returncode:
        return {} if "Invalid job id" in asked.stderr else None
    lines = (line.strip().split("|") for line in asked.stdout.splitlines())
    found = {parts[0]: JobState(*parts[1:]) for parts in lines if len(parts) == 3}
    return {job_id: found[job_id] for job_id in ids if job_id in found}


def summary(found: Iterable[JobState]) -> str:
    """How many jobs run and wait, and why, if it is not for their turn."""
    counts: dict[str, int] = {}
    reasons = set()
    for state in found:
        if state.name in LIVE:
            counts[state.name] = counts.get(state.name, 0) + 1
            if state.name == "PENDING" and state.reason not in NORMAL:
                reasons.add(state.reason)
    words = ", ".join(f"{number} {name.lower()}" for name, number in sorted(counts.items()))
    return words + f" ({', '.join(sorted(reasons))})" * bool(reasons)


def restarted() -> bool:
    """Whether this process is a job that SLURM started before."""
    return "SLURM_RESTART_COUNT" in os.environ


def resume_before_the_limit(folder: Path) -> None:
    """In a job: as its time limit comes near, lets SLURM queue it again, where the run resumes.

    submitit has SLURM send SIGUSR2 90 s before the limit.  A job that saved no episode would not
    get further the next time: it is left to its limit.

    Args:
      folder: Run folder.
    """
    number = os.environ.get("SLURM_JOB_ID")
    if os.environ.get("SUBMITIT_EXECUTOR") == "slurm" and number is not None:
        signal.signal(signal.SIGUSR2, _requeue(number, folder / "checkpoints"))


def _requeue(number: str, saved: Path) -> Callable[..., None]:
    before = checkpoint.newest(saved)

    def handle(*_: object) -> None:
        if checkpoint.newest(saved) == before:
            print("the time limit is near, and no episode was saved: not queued again", flush=True)
            return
        print("the time limit is near: queued again, to resume", flush=True)
        if subprocess.run(["scontrol", "requeue", number]).returncode == 0:
            os._exit(0)  # every saved episode is complete; nothing needs tidying

    return handle
