"""The design that a command is about: the best of a run, or one given on the command line."""

from itertools import chain
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import engines, runs
from codesign_jax.codesign import Task
from codesign_jax.commands import common
from codesign_jax.commands.flags import Subject
from codesign_jax.engines import make_engine
from codesign_jax.runs import choice
from codesign_jax.runs.interrupts import interruptible
from codesign_jax.runs.reading import Tell
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Outcome

PRESET = "2d"
"""Design space where none is named."""


class Case(NamedTuple):
    """A design and where it was found.

    Attributes:
      scene: The scene.
      space: The design space.
      design: The design [SI units], shape (parameter,).
      engine: Name of the engine that simulates it.
    """

    scene: Scene
    space: DesignSpace
    design: np.ndarray
    engine: str

    def simulate(self, trials: int, key: jax.Array) -> Outcome:
        """Outcomes in trials that depend on objects and key alone, arrays of shape (trial,)."""
        task = Task(self.scene, self.space, trials, make_engine(self.engine, self.scene))
        population = jnp.asarray(self.design, jnp.float32)[None]
        found = interruptible(task.evaluate, population, key)
        return jax.tree.map(lambda v: np.asarray(v)[0], found)


def find_case(options: Subject, *, tell: Tell = common.warn) -> Case:
    """The design that the flags name."""
    return _from_run(options, tell) if options.run_folder else _from_flags(options)


def _from_flags(options: Subject) -> Case:
    scene = common.load_scene(options)
    words = [*chain.from_iterable(options.design)]
    space = design_space(scene.hand, options.preset or common.open_designs(words)[1] or PRESET)
    design = common.find_design(space, words)
    return Case(scene, space, design, options.engine or engines.DEFAULT)


def _from_run(options: Subject, tell: Tell) -> Case:
    """The design of a run that tested best, or without a test the best of its last episode.

    Objects, accuracy and single values may differ from the run's.
    """
    own = {"--hand": options.hand, "--scene": options.scene, "--preset": options.preset}
    given = ["--design"] * bool(options.design) + [f for f, v in own.items() if v is not None]
    if given:
        flags = " and ".join(given)
        raise InputError([f"--run brings design, hand and scene of its own; leave out {flags}"])
    folder: Path = options.run_folder  # type: ignore[assignment]
    scene, settings = runs.read_run(
        folder,
        object_set=options.objects,
        accuracy=options.accuracy,
        overrides=common.changes(options),
    )
    # By the run's own rule for failed trials, whatever --set says.
    own_rule = runs.read_run(folder)[0]
    chosen = choice.choose(own_rule, choice.read_record(folder, tell=tell))
    if doubt := choice.doubt(chosen):
        tell(doubt)
    design = chosen.design
    space = design_space(scene.hand, settings.preset)
    if len(design) != space.num_parameters:
        raise InputError(
            [
                f"--set leaves {space.num_parameters} parameters free in preset "
                f"{settings.preset!r}; the run's designs have {len(design)}"
            ]
        )
    return Case(scene, space, design, options.engine or settings.engine)
