"""What a run is made of before it starts: task, optimiser, schedule and key."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import codesign, user_code
from codesign_jax.codesign import Task
from codesign_jax.engines import make_engine
from codesign_jax.optimize import Optimizer
from codesign_jax.policy import ControlLoop
from codesign_jax.runs.settings import SCENE_COST, Settings, masks_of, search_scene
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space


class Plan(NamedTuple):
    """A run that was checked and can start; see `prepare`."""

    task: Task  # of the episodes, at the accuracy of the search
    settings: Settings
    optimizer: Optimizer
    mask: np.ndarray
    key: jax.Array
    test_task: Task  # of the final test, at the scene's own accuracy; `task` where they are alike

    @property
    def scene(self) -> Scene:
        """The run's scene, which its final test simulates."""
        return self.test_task.scene

    @property
    def retests(self) -> bool:
        """Whether the final test has another accuracy than the search."""
        return self.test_task is not self.task

    @property
    def tests(self) -> tuple[Task, ...]:
        """Tasks of the final test: at the scene's accuracy and, for comparison, at the search's."""
        return (self.test_task, self.task) if self.retests else (self.task,)

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
        settings = self.settings
        return settings.episodes * settings.particles * settings.trials + self.test_grasps


def prepare(scene: Scene, settings: Settings) -> Plan:
    """Builds everything that a run needs in memory, so that errors come before any file.

    Args:
      settings: Settings without `settings.check`'s problems.

    Raises:
      InputError: If an optimiser, a cost or a policy of the user's own is none; see `user_code`.
    """
    space = design_space(scene.hand, settings.preset)
    mask = masks_of(scene, settings)
    n = settings.particles
    optimizer = codesign.make_optimizer(settings.optimizer, space, num_particles=n)
    test_task = _task(scene, space, settings)
    searched = search_scene(scene, settings)
    task = test_task if searched == scene else _task(searched, space, settings)
    key = jax.random.key(settings.seed)
    return Plan(task, settings, optimizer, mask, key, test_task)


def _task(scene: Scene, space: DesignSpace, settings: Settings) -> Task:
    engine = make_engine(settings.engine, scene)
    if settings.policy:
        engine = ControlLoop(engine, user_code.make_policy(settings.policy, scene)[0])
    task = Task(scene, space, settings.trials, engine)
    if settings.cost == SCENE_COST:
        return task
    cost, stops = user_code.make_cost(settings.cost, scene)
    return dataclasses.replace(task, cost=cost, record_qpos=not stops, stop_when_lost=stops)


def variant(plan: Plan, settings: Settings) -> Plan:
    """The same run with another seed, schedule or first domain; see `loop.optimize`.

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
