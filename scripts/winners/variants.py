"""Do winners hold?  Final particles simulated again with other engines, steps, hands, objects."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from codesign_jax import archives, codesign
from codesign_jax import scene as scenes
from codesign_jax.batch import LIMIT
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.commands import calls
from codesign_jax.engines import make_engine
from codesign_jax.scene import Scene, keypaths, parameters
from scripts.winners import files
from scripts.winners.files import Arrays

STREAM_WINNERS = 0x77696E6E
"""Stream of the noise of these trials ("winn"): none of them was met in a run."""

FINE = ("discretization.timestep=0.001", "discretization.links=20")
"""Overrides of the fine discretization."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """Under what final particles are simulated again.

    Attributes:
      name: Name.
      engine: Engine.
      best: Whether only the best particle of each run is simulated.
      friction: Factor on every coefficient of friction.
      stiffness: Factor on the silicone's shear modulus.
      objects: Object set; None for the scene's.
      overrides: Values that replace the scene's, "table.key=value".
      blocks: Blocks of trials at most; None for all.
    """

    name: str
    engine: str = "structured"
    best: bool = False
    friction: float = 1.0
    stiffness: float = 1.0
    objects: str | None = None
    overrides: tuple[str, ...] = ()
    blocks: int | None = None

    def scene(self, more: Sequence[str] = ()) -> Scene:
        """The scene that the winners were designed in, `paper_spheres`, changed.

        Args:
          more: Further overrides, which come first.
        """
        table = keypaths.parse([*more, *self.overrides])
        base = scenes.load("paper_spheres", object_set=self.objects, overrides=table)
        return scaled(base, self.friction, self.stiffness)


STANDARD = "standard"
VARIANTS = (
    Variant(STANDARD),
    Variant("friction -30 %", friction=0.7),
    Variant("friction +30 %", friction=1.3),
    Variant("stiffness -20 %", stiffness=0.8),
    Variant("stiffness +20 %", stiffness=1.2),
    Variant("hull", overrides=("effects.surface=hull",)),
    Variant("1 ms and 20 links", overrides=FINE),
    Variant("unseen meshes", objects="household"),
    Variant("MuJoCo C", engine="mujoco", best=True, blocks=2),
    Variant("MuJoCo C at 1 ms and 20 links", engine="mujoco", best=True, overrides=FINE, blocks=2),
)
"""The variants; the names of those of MuJoCo C are what they are compared by."""


def scaled(scene: Scene, friction: float, stiffness: float) -> Scene:
    """Scales every coefficient of friction of a scene and the stiffness of its fingers."""
    replace, objects, material = dataclasses.replace, scene.objects, scene.hand.material
    shapes = tuple(replace(s, friction=friction * s.friction) for s in objects.object)
    table = replace(objects.table, friction=friction * objects.table.friction)
    contact = scene.contact
    softer = replace(material, shear_modulus=stiffness * material.shear_modulus)
    return replace(
        scene,
        objects=replace(objects, object=shapes, table=table),
        contact=replace(contact, finger_table_friction=friction * contact.finger_table_friction),
        hand=replace(scene.hand, material=softer),
    )


@dataclasses.dataclass(frozen=True)
class Finals:
    """The final particles of an experiment's last strategy, the concurrent one.

    Attributes:
      name: Name of the experiment.
      preset: Design space.
      particles: Shape (run, particle, parameter), float32, the best of each run first.
      cost: Their test costs in the experiment, shape (run, particle), ascending.
    """

    name: str
    preset: str
    particles: np.ndarray
    cost: np.ndarray

    @property
    def successful(self) -> np.ndarray:
        """Whether each run found a particle that solves the task, bool, shape (run,)."""
        return self.cost.min(1) < SUCCESS_COST

    def chosen(self, best: bool) -> np.ndarray:
        """Particles, all or the best of each run, shape (run, particle, parameter)."""
        return self.particles[:, :1] if best else self.particles


def finals(data: Path, name: str, runs: int | None = None, particles: int | None = None) -> Finals:
    """Reads the final particles of an experiment's last strategy.

    Args:
      data: Folder with NAME.npz.
      name: Name of the experiment.
      runs: Number of runs, the first ones; None for all.
      particles: Number of particles of a run, the best ones; None for all.
    """
    with np.load(data / f"{name}.npz", allow_pickle=False) as file:
        every, cost = file["final_particles"][-1, :runs], file["test_exclude"][-1, :runs]
    order = np.argsort(cost, axis=1, kind="stable")[:, :particles]
    chosen = np.take_along_axis(every, order[..., None], 1)
    return Finals(name, name, chosen, np.take_along_axis(cost, order, 1))


@dataclasses.dataclass(frozen=True)
class Task:
    """One call: an experiment's particles under a variant, in one block of trials."""

    finals: Finals
    variant: Variant
    block: int
    trials: int

    @property
    def key(self) -> str:
        """Name in the results."""
        return f"{self.finals.name}|{self.variant.name}|{self.block}"

    def run(self, more: Sequence[str], limit: int = LIMIT) -> Arrays:
        """Simulates the block.

        Args:
          more: Overrides of every variant's scene.
          limit: Most worlds of a call of the engine.

        Returns:
          Costs (float16) and status of shape (run, particle, trial), by key.
        """
        scene = self.variant.scene(more)
        space = parameters.design_space(scene.hand, self.finals.preset)
        designs = self.finals.chosen(self.variant.best)
        flat = designs.reshape(-1, designs.shape[-1])
        size = calls.equal(len(flat), max(1, limit // self.trials))
        engine = make_engine(self.variant.engine, scene)
        task = codesign.Task(scene, space, self.trials, engine)
        key = codesign.stream_key(jax.random.key(0), STREAM_WINNERS, self.block)
        found = calls.joined([*calls.in_turn(task, key, flat, size)])
        shape = (*designs.shape[:2], self.trials)
        return {
            f"{self.key}|cost": found.cost.reshape(shape).astype(np.float16),
            f"{self.key}|status": found.status.reshape(shape).astype(np.uint8),
        }


def tasks(
    every: Sequence[Finals], variants: Sequence[Variant], blocks: int, trials: int
) -> list[Task]:
    """All calls, the first blocks of every variant first."""
    found = []
    for block in range(blocks):
        for variant in variants:
            if block < (variant.blocks or blocks):
                found += [Task(f, variant, block, trials) for f in every]
    return found


def drive(
    todo: Sequence[Task],
    path: Path,
    settings: dict[str, Any],
    *,
    more: Sequence[str] = (),
    budget: float = np.inf,
    limit: int = LIMIT,
    say: Callable[[str], None] = print,
    note: Callable[[str], None] = lambda key: None,
) -> tuple[Arrays, bool]:
    """Runs the calls that are left; the same call starts and resumes.

    Args:
      todo: The calls.
      path: File of the results, written after each.
      settings: What the file must belong to.
      more: Overrides of every variant's scene.
      budget: Seconds to begin calls in.
      limit: Most worlds of a call of the engine.
      say: Told one line a call.
      note: Told the key of a call before its results are written.

    Returns:
      The results, and whether all calls are done.

    Raises:
      InputError: If the file belongs to other settings.
      ArchiveError: If it is damaged.
    """
    begin, longest = time.monotonic(), 0.0
    results: Arrays = {}
    if path.exists():
        results, found, _ = files.read(path)
        files.refuse_others(path, found, settings)
    left = [t for t in todo if f"{t.key}|cost" not in results]
    for number, task in enumerate(left, 1):
        start = time.monotonic()
        if start - begin + longest > budget:
            say(f"no time left for {len(left) - number + 1} of {len(todo)} calls")
            return results, False
        new = task.run(more, limit)
        seconds = time.monotonic() - start
        longest = max(longest, seconds)
        results |= new | {f"{task.key}|seconds": np.float64(seconds)}
        note(task.key)
        archives.save(path, results, compressed=True)
        cost = new[f"{task.key}|cost"]
        say(
            f"[{number}/{len(left)}] {task.key}: {cost.size:,} grasps, {(cost == 0).mean():.1%} "
            f"kept, {(new[f'{task.key}|status'] != 0).sum()} failed, {seconds:.1f} s"
        )
        jax.clear_caches()
    return results, True


def gather(results: Arrays, name: str, variant: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Costs and status of an experiment under a variant, (run, particle, trial); None if not run.

    Failed trials have the scene's maximum as their cost.
    """
    found = []
    for block in range(len(results)):
        key = f"{name}|{variant}|{block}"
        if f"{key}|cost" not in results:
            break
        found.append((results[f"{key}|cost"].astype(np.float32), results[f"{key}|status"]))
    if not found:
        return None
    cost, status = (np.concatenate(part, -1) for part in zip(*found, strict=True))
    return cost, status
