"""A run in its open folder: the checkpoint is the truth, tables and messages are made from it."""

import contextlib
from pathlib import Path
from traceback import format_exception
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import codesign, preflight, types
from codesign_jax.codesign import EpisodeInfo, FinalTest
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.judge import verdict
from codesign_jax.optimize import NoSeed, OptimizerState
from codesign_jax.runs import failures, reading, tables
from codesign_jax.runs import record as records
from codesign_jax.runs.checkpoint import Checkpoints
from codesign_jax.runs.directory import RunDirectory
from codesign_jax.runs.errors import AllFailed, RunError
from codesign_jax.runs.plan import Plan
from codesign_jax.runs.progress import Report, Voice
from codesign_jax.runs.record import Record, Start
from codesign_jax.runs.settings import SCENE_COST
from codesign_jax.scene import accuracy_name, texts
from codesign_jax.types import Outcome, Status

FAILURES = (OSError, RunError, NoSeed, KernelUnavailable)
"""How a run may fail: what it has cannot be saved, no seed is found, every trial failed, or the
engine cannot run here.

Any other error is unexpected: its traceback is kept.
"""


class RunResult(NamedTuple):
    """How a run ended.

    Attributes:
      record: State and history, or None if the run was stopped before it had a seed.
      test: The final test, or None if there was none.
    """

    record: Record | None
    test: FinalTest | None


class Run:
    """One run, which saves what it is told.

    Attributes:
      record: State and reports of its episodes; None before it has a seed.
      error: Why it ended, or None.
    """

    def __init__(self, plan: Plan, directory: RunDirectory, store: Checkpoints, voice: Voice):
        """Takes the run, its open folder and checkpoints, and what tells the user."""
        self.plan = plan
        self.record: Record | None = None
        self.error: Exception | None = None
        self._directory = directory
        self._store = store
        self._voice = voice
        self._unsaved: EpisodeInfo | None = None
        self._explained = False  # whether it was said why worlds cannot start

    @property
    def state(self) -> OptimizerState:
        assert self.record is not None
        return self.record.state

    @property
    def done(self) -> int:
        """Number of finished episodes."""
        return 0 if self.record is None else self.record.done

    @property
    def over(self) -> bool:
        """Whether nothing is left to simulate."""
        if self.record is None or self.done < self.plan.settings.episodes:
            return False
        return self.record.test is not None or self.plan.settings.test_trials == 0

    @property
    def result(self) -> "RunResult | Exception":
        """How the run ended, or where it was stopped."""
        if self.error is not None:
            return self.error
        test = None
        if self.record is not None and self.record.test is not None:
            test = codesign.summarize_test(self.plan.scene, self.record.test)
        return RunResult(self.record, test)

    def restore(self) -> None:
        """Goes on from the newest whole checkpoint, if there is any."""
        restored = self._store.restore(records.refuse_other_arrays)
        if restored.step is None and (problem := reading.lost(self._directory.path, restored)):
            raise RunError(problem)
        if restored.step is not None:
            record = records.from_arrays(restored.arrays)
            records.refuse_other(record, self.plan.settings)
            self.record = record
        instead = "the run begins anew" if self.record is None else "using an older one"
        for step, reason in restored.damaged[: texts.FEW]:
            self.say(f"checkpoint {step} is lost: {reason}; {instead}")
        if (rest := len(restored.damaged) - texts.FEW) > 0:
            self.say(f"{rest:,} more checkpoints are lost; {instead}")
        self._store.discard([step for step, _ in restored.damaged])
        if self.record is not None:
            self._go_on(self.record, restored.step)

    def _go_on(self, record: Record, step: int | None) -> None:
        total = self.plan.settings.episodes
        if record.done < total and record.test is not None and step is not None:
            # The run was extended: its test was of particles that are no longer final, and the next
            # episode takes the step of that test.
            record.test = record.searched = None
            self._store.discard([step])
        record.history = records.with_room(record.history, total)
        where = self._directory.path
        if record.done < total:
            self.say(f"resuming episode {record.done + 1}/{total} from {where}")
        else:
            self.say(f"all {total} episodes are done in {where}")
        self._write_tables(0)
        self._refuse_all_failed()

    def begin(self, seed: jax.Array, start: Start | None = None) -> None:
        """Begins at a seed particle [SI units], shape (parameter,)."""
        plan = self.plan
        state = plan.optimizer.init(plan.key, seed, plan.settings.particles)
        history = records.empty_history(plan.settings, plan.space.num_parameters)
        self.record = Record(state, history, start=start)
        if start is not None:
            cost = float(start.cost)
            self.say(f"seed particle: cost {cost:.3f}, candidate {int(start.candidates)}")
        self._keep(0)
        self._write_tables(0)

    def add(self, state: OptimizerState, info: EpisodeInfo) -> None:
        """Takes an episode, which `save` keeps: arrays of NumPy, but for the key."""
        assert self.record is not None
        records.add_report(self.record.history, self.done, info)
        self.record.state = state
        self._unsaved = info

    def save(self) -> None:
        """Keeps and reports the episode that was added last, unless that has been done.

        It asks nothing of the devices, which simulate the next one.
        """
        info = self._unsaved
        self._unsaved = None
        if info is None:
            return
        self._save_failures(info)
        self._keep(self.done)
        self._write_tables(self.done - 1)
        self._report()
        self._refuse_all_failed()

    def finish(self, test: Outcome, searched: Outcome | None = None) -> None:
        """Keeps the final test: outcomes of the final particles in its own trials.

        Args:
          searched: Outcomes in the same trials at the accuracy of the search, if it is another.
        """
        assert self.record is not None
        if not self.plan.optimizer.keeps_best and searched is None:
            # Outcomes by which the best particles so far were chosen are too good to count.
            last = self.record.last_outcomes()
            test = jax.tree.map(lambda *v: np.concatenate(v, axis=1), last, test)
        self.record.test = test
        self.record.searched = searched
        self._keep(self.plan.settings.episodes + 1)
        self._write_tables(self.done)
        self._refuse_all_failed()
        words = f"final test: {self.plan.test_grasps} grasps"
        if (again := self.record.retest) is not None:
            words += f" at accuracy {accuracy_name(self.plan.scene) or 'of the scene'}"
            words += f"; {again.sentence(self.plan.settings.search_accuracy)}"
        self.say(words)

    def fail(self, error: Exception) -> None:
        """Ends the run; events.log has the traceback as well, where it is none of `FAILURES`."""
        self.error = error
        text = str(error) if isinstance(error, FAILURES) else "".join(format_exception(error))
        with contextlib.suppress(OSError, RunError):  # a full disk may be why it failed
            for line in f"failed: {text.rstrip()}".splitlines():
                self.log(line)

    def say(self, message: str) -> None:
        self._voice.message(message)
        self.log(message)

    def log(self, message: str) -> None:
        self._directory.log(message)

    def _keep(self, step: int) -> None:
        assert self.record is not None
        self._directory.here()
        self._store.save(step, records.to_arrays(self.record))

    def _write_tables(self, since: int) -> None:
        assert self.record is not None
        plan = self.plan
        tables.write_run(self._directory.here(), plan.scene, plan.space, self.record, since)

    def _save_failures(self, info: EpisodeInfo) -> None:
        if types.failed(info.outcomes.status).any():
            for path in failures.save(self._directory.here(), self.done, info):
                self.log(f"failed world: codesign replay {path}")
        started_inside = (np.asarray(info.outcomes.status) & Status.INVALID_START) != 0
        if started_inside.any() and not self._explained:
            self._explained = True
            particle, number = np.argwhere(started_inside)[0]
            params = self.plan.space.params(info.population[particle])
            trial = jax.tree.map(lambda v: np.asarray(v)[number], info.drawn)
            for text in preflight.why_invalid(self.plan.task.scene, params, trial):
                self.say(f"warning: particle {particle}, trial {number}: {text}")

    def _report(self) -> None:
        assert self.record is not None
        history = self.record.history
        status = history.outcomes.status[self.done - 1]
        cost = history.cost[self.done - 1]
        ends = verdict.failure_counts(status), verdict.warning_counts(status)
        failed = int(types.failed(status).sum())
        report = Report(
            self.done, float(cost.mean()), float(cost.min()), failed, status.size, *ends
        )
        self.log(self._voice.episode(report))

    def _refuse_all_failed(self) -> None:
        """Ends a run whose last episode or final test has not one trial that did not fail."""
        assert self.record is not None
        outcomes = self.record.failed_outcomes()
        if outcomes is not None:
            refuse_all_failed(outcomes, self._directory.path, self.plan.settings.cost)


def refuse_all_failed(outcomes: Outcome, folder: Path, cost: str) -> None:
    status = np.asarray(outcomes.status)
    # A state that is no number has a first bad step; a cost of the user's that is none has none.
    of_cost = ((status & Status.NONFINITE) != 0) & (np.asarray(outcomes.bad_step) < 0)
    of_cost &= cost != SCENE_COST
    rest = np.where(of_cost, status & ~Status.NONFINITE, status)
    advice = [text for bit, text in _ADVICE.items() if (rest & bit).any()]
    if of_cost.any():
        advice.insert(
            0,
            f"--cost {cost} returned NaN or an infinite number in {of_cost.sum()} of them: it must "
            "be finite whatever a grasp does.",
        )
    raise AllFailed(
        f"every one of {status.size} trials failed ({verdict.failure_counts(status)}); see "
        f"trials.csv and codesign replay {folder}. " + " ".join(advice)
    )


_UNSTABLE = (
    "A smaller discretization.timestep may help, or more iterations: newton.iterations with engine "
    "structured, solver.iterations with MuJoCo's."
)
_ADVICE = {
    Status.NONFINITE | Status.SPEED: _UNSTABLE,
    Status.PENETRATION: "The object falls through the table: contact.normal_stiffness is too low "
    "for its mass, or discretization.timestep too large.",
    Status.CONTACT_OVERFLOW: "MuJoCo has no memory for this many contacts: fewer "
    "discretization.spheres_per_link, or another engine.",
    Status.INVALID_START: "The hand starts inside the table or the object: raise arm.start_height.",
    Status.STUCK: "The hand does not let go in time: more time between phases.disturb and "
    "phases.ungrasp, or a shorter phases.deflate_time.",
}
