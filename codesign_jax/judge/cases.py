"""A design with what simulates it, and where its commands leave the key frames."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import batch, control, rollout, user_code
from codesign_jax.engines import Engine, make_engine
from codesign_jax.interrupts import interruptible
from codesign_jax.model import morphology
from codesign_jax.policy import ControlLoop
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.scene import Scene, key_frames, scene_files
from codesign_jax.scene.hand import lacking
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.scene.schema import InputError, Problem, range_problem
from codesign_jax.types import Outcome, Params, Trial


class Departure(NamedTuple):
    """Where commands differ from those of the key frames, by trial."""

    time: Any  # when they first do [s], inf if they never do, shape (trial,)
    lower: Any  # most that a pressure is lowered, at most 0 [Pa], shape (trial,)
    higher: Any  # most that one is raised [Pa], shape (trial,)
    place: Any  # farthest that the arm is from its place [m], shape (trial,)
    turn: Any  # largest angle of the arm's joints from theirs [rad], shape (trial,)

    def __str__(self) -> str:
        """In words, such as "left the key frames in 3 of 20 grasps, first after 1.3 s (median)"."""
        departed = np.isfinite(self.time)
        if not departed.any():
            return f"commanded nothing but the key frames in {departed.size} grasps"
        low, high = (1e-3 * f(v) for f, v in ((np.min, self.lower), (np.max, self.higher)))
        return (
            f"left the key frames in {departed.sum()} of {departed.size} grasps, first after "
            f"{np.median(self.time[departed]):.3g} s (median); pressures by {low:.3g} to "
            f"{high:+.3g} kPa, the arm by up to {1e3 * np.max(self.place):.3g} mm and "
            f"{np.degrees(np.max(self.turn)):.3g}°"
        )


class Case(NamedTuple):
    """A design with what simulates it."""

    scene: Scene
    space: DesignSpace
    design: np.ndarray  # the design [SI units], shape (parameter,)
    engine: str  # name of the engine
    # Name of the user's own policy that commands the hand; empty for the key frames alone
    policy: str = ""

    @property
    def commanded(self) -> str:
        """Names of engine and policy."""
        return f"{self.engine} {self.policy}".strip()

    @property
    def air(self) -> float:
        """Air in all unloaded chambers [cm^3]."""
        return float(morphology.air(self.scene.hand, self.space.params(self.design)))

    def make_engine(self, scene: Scene | None = None) -> Engine:
        """The engine of the scene, or of one that differs from it, with the policy if any."""
        scene = scene or self.scene
        engine = make_engine(self.engine, scene)
        if not self.policy:
            return engine
        return ControlLoop(engine, user_code.make_policy(self.policy, scene)[0])

    def without(self, fingers: tuple[int, ...]) -> "Case":
        """The design with fewer fingers: another hand, whose fingers are counted anew.

        Raises:
          InputError: If the hand has not these fingers, or no other ones, or it has a policy.
        """
        count = self.scene.num_fingers
        outside = [range_problem("--without", f, "", 0, count - 1) for f in fingers]
        problems = [problem for problem in outside if problem]
        if len({*fingers}) == count:
            problems.append(Problem("conflict", "--without names all fingers of the hand"))
        if self.policy:
            problems.append(
                Problem(
                    "conflict", "--without: a policy commands all fingers of its hand; leave it out"
                )
            )
        if problems:
            raise InputError(problems)
        leaving = tuple(sorted({*fingers}))
        hand = lacking(self.scene.hand, self.space.table(self.design), leaving)
        scene = dataclasses.replace(
            self.scene, hand=hand, control=key_frames.lacking(self.scene.control, leaving)
        )
        space = design_space(hand, "full")
        return self._replace(scene=scene, space=space, design=space.default())

    def simulate(self, trials: int, key: jax.Array, first: int = 0) -> Outcome:
        """Outcomes in trials that depend on objects and key alone, arrays of shape (trial,).

        Args:
          trials: Number of trials.
          key: Typed key.
          first: Index of the first of them, see `rollout.sample_trials`: more of the same trials
            are the same program.
        """
        return self.observe(trials, key, first)[0]

    def observe(
        self, trials: int, key: jax.Array, first: int = 0
    ) -> tuple[Outcome, Departure | None]:
        """As `simulate`, and where a policy left the key frames; None without a policy."""
        design = jnp.asarray(self.design, jnp.float32)
        self.space.check(design[None])
        if not self.policy:
            return interruptible(self._in_batch, trials, key, first), None
        run = SceneProgram(self.scene, _in_trials(self.make_engine(), self.space, trials))
        return jax.tree.map(np.asarray, interruptible(run, design, (key, jnp.asarray(first))))

    def _in_batch(self, trials: int, key: jax.Array, first: int) -> Outcome:
        """Outcomes by the program that other batches have as well, see `batch.Batch`."""
        every = batch.Batch(self.scene, self.make_engine(), rollout.Options())
        return every.simulate(*self._worlds(trials, key, first))[0]

    def _worlds(self, trials: int, key: jax.Array, first: int) -> tuple[Params, Trial]:
        """The hand in each trial, and the trials, leading axis (trial,)."""
        design = np.asarray(self.design, np.float32)
        noise = rollout.sample_trials(self.scene, key, trials, first)
        hand = self.space.params(design)
        return jax.tree.map(lambda v: np.repeat(np.asarray(v)[None], trials, 0), hand), noise

    def compile(self, trials: int, options: rollout.Options) -> None:
        """Compiles ahead what simulates so many trials, of a design that has no policy.

        By an engine that fills its batches, see `Engine`.
        """
        every = batch.Batch(self.scene, self.make_engine(), options)
        every.compile(*self._worlds(trials, jax.random.key(0), 0))

    def digest(self, *numbers: int) -> str:
        """Digest of what determines outcomes, beside code, versions and device."""
        return scene_files.digest(self.scene, self.commanded, self.design, *numbers)


@shared
def _in_trials(engine: Engine, space: DesignSpace, num_trials: int) -> Callable:
    def simulated(
        design: jax.Array, noise: tuple[jax.Array, jax.Array], scene: Scene
    ) -> tuple[Outcome, Departure | None]:
        trials = rollout.sample_trials(scene, noise[0], num_trials, noise[1])
        hand = jax.tree.map(lambda v: v[None], space.params(design))
        worlds = rollout.crossed(scene, hand, trials)
        outcome, trace = rollout.simulate(worlds[0], engine, *worlds[1:])
        if trace.ctrl is None:
            return outcome, None
        planned = jax.vmap(partial(control.commands, scene))(*worlds[1:])
        return outcome, departure(scene, outcome, trace.ctrl, planned)

    return simulated


LEAST = 1e-5
"""Difference of a command, in bar, metres or radians, from which on it is one: rounding is less."""


def departure(scene: Scene, outcomes: Outcome, ctrl: jax.Array, planned: jax.Array) -> Departure:
    """Where commands of grasps leave the key frames, until each grasp was decided.

    Args:
      scene: The scene.
      outcomes: How the grasps ended, arrays of shape (trial,).
      ctrl: Commands, shape (trial, time, 6 + finger): the arm's places [m] and angles [rad], and
        pressures [Pa].
      planned: Those of the key frames, of the same shape.
    """
    steps = ctrl.shape[1]
    h = scene.discretization.timestep
    end = jnp.where(outcomes.bad_step < 0, steps, outcomes.bad_step)
    end = jnp.minimum(
        end, jnp.where(jnp.isfinite(outcomes.lost_time), outcomes.lost_time / h, steps)
    )
    counts = np.arange(steps) < end[:, None]
    apart = jnp.where(counts[..., None], ctrl - planned, 0.0)
    distance = jnp.linalg.norm(apart[..., :3], axis=-1)
    turn = jnp.abs(apart[..., 3:6]).max(-1)
    pressure = apart[..., 6:]
    size = jnp.maximum(jnp.maximum(distance, turn), 1e-5 * jnp.abs(pressure).max(-1))
    departs = size > LEAST
    first = jnp.where(departs.any(1), departs.argmax(1) * h, jnp.inf)
    lower = jnp.minimum(pressure, 0).min((1, 2))
    higher = jnp.maximum(pressure, 0).max((1, 2))
    return Departure(first, lower, higher, distance.max(1), turn.max(1))
