"""The optimisation of one run: seed, episodes, final test; saved after every step and resumable.

A run is a generator that yields the episodes it wants and is sent what became of them, so that
`together` simulates those of several runs at once.  An episode is saved while the devices simulate
the next one, see `Loop.save`.
"""

import dataclasses
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, optimize, types, user_code
from codesign_jax.batch import Request
from codesign_jax.codesign import EpisodeInfo, FinalTest, Task
from codesign_jax.engines import make_engine
from codesign_jax.optimize import NoSeed, Optimizer, OptimizerState, translated
from codesign_jax.policy import ControlLoop
from codesign_jax.runs import failures, reading, tables
from codesign_jax.runs import record as records
from codesign_jax.runs.checkpoint import Checkpoints
from codesign_jax.runs.directory import RunDirectory
from codesign_jax.runs.errors import AllFailed, RunError
from codesign_jax.runs.interrupts import Stopped
from codesign_jax.runs.progress import Report, Voice
from codesign_jax.runs.record import History, Record, Start
from codesign_jax.runs.settings import SCENE_COST, Settings, masks_of
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.types import Outcome, Status

Asking = Generator[Request, tuple[OptimizerState, EpisodeInfo], Any]
"""What yields episodes and is sent the state after each and its report."""


def fetch(tree: Any) -> Any:
    """The tree as NumPy arrays, and keys as numbers.

    JAX keeps the host's copy with each array of the tree, so that nothing is copied a second time.
    """
    return jax.tree.map(np.asarray, jax.tree.map(_numbers, tree))


def begin_fetch(tree: Any) -> None:
    """Starts the copies from the devices that `fetch` waits for, all of them at once."""
    for array in jax.tree.leaves(jax.tree.map(_numbers, tree)):
        if isinstance(array, jax.Array):
            array.copy_to_host_async()


def _numbers(array: Any) -> Any:
    typed = isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(array) if typed else array


class Plan(NamedTuple):
    """A run that was checked and can start; see `prepare`."""

    task: Task
    settings: Settings
    optimizer: Optimizer
    mask: np.ndarray
    key: jax.Array

    @property
    def scene(self) -> Scene:
        return self.task.scene

    @property
    def space(self) -> DesignSpace:
        return self.task.space

    @property
    def finalists(self) -> int:
        """Particles that the final test simulates; see `optimize.Optimizer`."""
        every = self.settings.particles
        if self.settings.episodes <= getattr(self.optimizer, "begins", 0):
            return every  # the run ends among random designs, which all differ
        return min(every, getattr(self.optimizer, "finalists", every))

    @property
    def test_grasps(self) -> int:
        return self.finalists * self.settings.trials * self.settings.test_rounds

    @property
    def grasps(self) -> int:
        """Grasps of the episodes and the final test, without those that find the seed."""
        own = self.settings
        return own.episodes * own.particles * own.trials + self.test_grasps


class RunResult(NamedTuple):
    """How a run ended.

    Attributes:
      record: OptimizerState and history, or None if the run was stopped before it had a seed.
      test: The final test, or None if there was none.
      signum: Signal that stopped the run early, or 0.
    """

    record: Record | None
    test: FinalTest | None
    signum: int


def prepare(scene: Scene, settings: Settings) -> Plan:
    """Builds everything that a run needs in memory, so that errors come before any file.

    Args:
      settings: Settings without `settings.check`'s problems.

    Raises:
      InputError: If an optimiser, a cost or a policy of the user's own is none; see `user_code`.
    """
    space = design_space(scene.hand, settings.preset)
    mask = masks_of(scene, settings)
    engine = make_engine(settings.engine, scene)
    if settings.policy:
        engine = ControlLoop(engine, user_code.make_policy(settings.policy, scene)[0])
    n = settings.particles
    optimizer = codesign.make_optimizer(settings.optimizer, space, num_particles=n)
    task = Task(scene, space, settings.trials, engine)
    key = jax.random.key(settings.seed)
    if settings.cost != SCENE_COST:
        cost, stops = user_code.make_cost(settings.cost, scene)
        how = {"record_qpos": not stops, "stop_when_lost": stops}
        task = dataclasses.replace(task, cost=cost, **how)
    return Plan(task, settings, optimizer, mask, key)


def variant(plan: Plan, settings: Settings) -> Plan:
    """The same run with another seed, schedule or first domain; see `together.optimize`.

    Args:
      plan: The run.
      settings: Its settings, in which nothing but these three may differ.

    Raises:
      ValueError: If something else differs.
    """
    free = {name: getattr(settings, name) for name in ("seed", "schedule", "first")}
    if dataclasses.replace(plan.settings, **free) != settings:
        raise ValueError(f"{settings} differs from {plan.settings} in more than {[*free]}")
    mask = masks_of(plan.scene, settings)
    key = jax.random.key(settings.seed)
    return plan._replace(settings=settings, mask=mask, key=key)


def needs_poor_seed(plan: Plan) -> bool:
    """Whether a run begins with the paper's search for a poor design.

    It does not where the optimiser looks for its start by itself, nor with a cost of one's own, of
    whose scale the paper's limit says nothing: such runs begin at the first random design.
    """
    return plan.task.cost is None and not getattr(plan.optimizer, "screens", False)


class Loop:
    """One process's part of a run."""

    def __init__(
        self,
        plan: Plan,
        run: RunDirectory,
        store: Checkpoints,
        progress: Voice,
        *,
        every: int = 1,
    ):
        """Takes the run, its open folder and checkpoints, what to tell, and episodes per save."""
        self.plan = plan
        self.run_directory = run
        self.store = store
        self.progress = progress
        self._every = every
        self._saved = 0
        self._unsaved: Callable[[], None] | None = None

    def run(self) -> Generator[Request, tuple[OptimizerState, EpisodeInfo], RunResult]:
        """Runs what is left of the run; to stop it, `Stopped` is thrown in."""
        record = self._restore()
        signum = 0
        try:
            if record is None:
                record = yield from self._seed()
            self._mend_tables(record)
            self._refuse_all_failed(record)
            yield from self._episodes(record)
            self.save()
            yield from self._test(record)
        except Stopped as stop:
            self.save()
            if record is not None and record.done > self._saved:
                self._save(record.done, record)
            signum = stop.signum
            self.run_directory.log(f"stopped by signal {signum}; the same command resumes")
        test = None if record is None else _final_test(self.plan, record)
        return RunResult(record, test, signum)

    def save(self) -> None:
        """Saves and reports the last episode, unless that has been done.

        With `every` above 1 most episodes are reported alone: a process that is killed repeats
        those since the last checkpoint. The run does so by itself before its next episode is over;
        whoever drives it may ask for it while that episode is simulated. It asks nothing of the
        devices, which are busy then.
        """
        unsaved = self._unsaved
        self._unsaved = None
        if unsaved is not None:
            unsaved()

    def _tested(self, record: Record) -> bool:
        return record.test is not None or self.plan.settings.test_trials == 0

    def _restore(self) -> Record | None:
        found = self.store.restore()
        if found.step is None:
            if problem := reading.lost(self.run_directory.path, found):
                raise RunError(problem)
            for step, reason in found.damaged:
                self._say(f"checkpoint {step} is lost: {reason}; the run begins anew")
            self.store.discard([step for step, _ in found.damaged])
            return None
        record = records.from_arrays(found.arrays)
        self._saved = found.step
        plan = self.plan
        records.refuse_other(record, plan.settings)
        for step, reason in found.damaged:
            self._say(f"checkpoint {step} is lost: {reason}; using an older one")
        self.store.discard([step for step, _ in found.damaged])
        done = record.done
        total = plan.settings.episodes
        if done < total and record.test is not None:
            # The run was extended: its test was of particles that are no longer final, and the next
            # episode takes the step of that test.
            record.test = None
            self.store.discard([found.step])
            (self.run_directory.path / tables.TESTS).unlink(missing_ok=True)
        record.history = records.with_room(record.history, total)
        if done < total:
            self._say(f"resuming episode {done + 1}/{total} from {self.run_directory.path}")
        else:
            self._say(f"all {total} episodes are done in {self.run_directory.path}")
        return record

    def _seed(self) -> Generator[Request, tuple[OptimizerState, EpisodeInfo], Record]:
        plan = self.plan
        settings = self.plan.settings
        if needs_poor_seed(plan):
            start = yield from self._poor_seed()
            seed = start.design
        else:
            start = None
            seed = optimize.candidates(plan.key, plan.optimizer.space, [0])[0]
        state = plan.optimizer.init(plan.key, seed, settings.particles)
        history = records.empty_history(settings, plan.space.num_parameters)
        record = Record(state, history, start=start)
        self._save(0, record)
        return record

    def _poor_seed(self) -> Generator[Request, tuple[OptimizerState, EpisodeInfo], Start]:
        plan = self.plan
        batch = self.plan.settings.particles
        search = codesign.seed_search(plan.scene, plan.optimizer, plan.key, batch=batch)
        self.progress.begin("looking for a poor seed")
        try:
            seed, cost, drawn = yield from self._evaluated(search)
        except NoSeed as error:
            raise RunError(str(error)) from error
        self._say(f"seed particle: cost {cost:.3f}, candidate {drawn}")
        return Start(np.asarray(seed), np.asarray(cost, np.float32), np.asarray(drawn))

    def _evaluated(
        self,
        asking: Generator[tuple[jax.Array, jax.Array], Outcome, Any],
        told: Callable[[], None] = lambda: None,
    ) -> Asking:
        """Answers what asks for populations by episodes in which nothing moves; tells of each."""

        def answer(reply: tuple[OptimizerState, EpisodeInfo]) -> Outcome:
            told()
            return reply[1].outcomes

        return translated(
            asking,
            lambda asked: Request(*codesign.closed(self.plan.optimizer, *asked)),
            answer,
        )

    def _episodes(self, record: Record) -> Asking:
        for e in range(record.done, self.plan.settings.episodes):
            self.progress.begin("simulating")
            state, info = yield Request(record.state, self.plan.mask[e])
            self.save()
            record.state = state
            # The devices have nothing to do until the next episode begins. Their results are copied
            # now, since a copy may wait for a simulation that has begun; all else is done then.
            fetched = fetch((state, info))[1]
            self._unsaved = partial(self._close, record, e, fetched)

    def _close(self, record: Record, e: int, info: EpisodeInfo) -> None:
        records.add_report(record.history, e, info)
        self._save_failures(e, info)
        last = e + 1 == self.plan.settings.episodes or record.failed_outcomes() is not None
        if last or (e + 1) % self._every == 0:
            self._save(e + 1, record)
        self._write_tables(record, e)
        self._report(record.history, e)
        self._refuse_all_failed(record)

    def _refuse_all_failed(self, record: Record) -> None:
        """Ends a run whose last episode or final test has not one trial that did not fail."""
        outcomes = record.failed_outcomes()
        if outcomes is not None:
            refuse_all_failed(outcomes, self.run_directory.path, self.plan.settings.cost)

    def _save_failures(self, e: int, info: EpisodeInfo) -> None:
        if not types.failed(np.asarray(info.outcomes.status)).any():
            return
        for path in failures.save(self.run_directory.path, e + 1, info):
            self.run_directory.log(f"failed world: codesign replay {path}")

    def _test(self, record: Record) -> Asking:
        plan = self.plan
        settings = self.plan.settings
        if self._tested(record):
            return
        # Outcomes by which the best particles so far were chosen are too good to count.
        previous = None if plan.optimizer.keeps_best else record.last_outcomes()
        particles, same = finalists(plan, np.asarray(record.state.particles))
        testing = codesign.testing(
            plan.scene,
            jnp.asarray(particles),
            plan.key,
            num_trials=settings.test_trials,
            previous=previous,
        )
        batch = len(particles) * settings.trials
        self.progress.begin("testing the final particles")
        test = yield from self._evaluated(testing, partial(self.progress.tested, batch))
        record.test = jax.tree.map(lambda v: np.asarray(v)[same], test.outcomes)
        self._save(settings.episodes + 1, record)
        self._write_tables(record, settings.episodes)
        self._refuse_all_failed(record)
        self._say(f"final test: {batch * settings.test_rounds} grasps")

    def _report(self, history: History, e: int) -> None:
        status = history.outcomes.status[e]
        cost = history.cost[e]
        ends = tables.failure_counts(status), tables.warning_counts(status)
        failed = int(types.failed(status).sum())
        report = Report(e + 1, float(cost.mean()), float(cost.min()), failed, status.size, *ends)
        self.run_directory.log(self.progress.episode(report))

    def _save(self, step: int, record: Record) -> None:
        self.store.save(step, records.to_arrays(record))
        self._saved = step

    def _write_tables(self, record: Record, start: int) -> None:
        plan = self.plan
        folder = self.run_directory.path
        tables.write_episodes(folder, plan.scene, plan.space, record.history, start, record.done)
        test = _final_test(plan, record)
        if test is not None:
            tables.write_tests(folder, plan.space, np.asarray(record.state.particles), test)

    def _mend_tables(self, record: Record) -> None:
        plan = self.plan
        folder = self.run_directory.path
        mended = tables.mend(folder, plan.scene, plan.space, record, _final_test(plan, record))
        if mended and record.done:
            names = ", ".join(mended)
            self._say(f"{names}: differed from the checkpoints, and written again from these")

    def _say(self, message: str) -> None:
        self.progress.message(message)
        self.run_directory.log(message)


def finalists(plan: Plan, particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Particles that the final test simulates, and for each final particle its place among them.

    They are all of them, unless the optimiser says that few differ, and so few do.
    """
    every = len(particles)
    most = plan.finalists
    _, first, same = np.unique(particles, axis=0, return_index=True, return_inverse=True)
    if most >= every or len(first) > most:
        return particles, np.arange(every)
    return particles[np.resize(first, most)], same.ravel()


def _final_test(plan: Plan, record: Record) -> FinalTest | None:
    return None if record.test is None else codesign.summarize_test(plan.scene, record.test)


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
        f"every one of {status.size} trials failed ({tables.failure_counts(status)}); see "
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
