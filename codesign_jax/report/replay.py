"""A grasp to be drawn, and the camera that sees it."""

from typing import NamedTuple

import jax
import numpy as np

from codesign_jax.batch import Batch
from codesign_jax.engines import Engine
from codesign_jax.rollout import Options
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Params, Trace, Trial


class Camera(NamedTuple):
    """MuJoCo's free camera.

    Attributes:
      azimuth: Direction of view about the vertical, 0 along x and 90 along y [deg].
      elevation: Direction of view above the horizontal, -90 straight down [deg].
      distance: Distance from the point looked at [m].
      lookat: That point [m].
    """

    azimuth: float = 125.0
    elevation: float = -20.0
    distance: float = 0.62
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.15)


class Replay(NamedTuple):
    """A grasp to be drawn.

    Attributes:
      params: Parameters of the hand, concrete arrays without leading axis.
      trial: Object and noise, likewise.
      outcome: How it ended, likewise.
      qpos: Generalized positions at every time step, shape (time, nq).
      trace: What else was recorded of it, likewise; None if that is not known.
    """

    params: Params
    trial: Trial
    outcome: Outcome
    qpos: np.ndarray
    trace: Trace | None = None


def replay(scene: Scene, engine: Engine, params: Params, trials: Trial) -> list[Replay]:
    """Simulates one hand in several trials and keeps the trajectories."""
    count = trials.yaw.shape[0]
    worlds = jax.tree.map(lambda v: np.broadcast_to(v, (count, *np.shape(v))), params)
    outcomes, trace = Batch(scene, engine, Options(record_qpos=True)).simulate(worlds, trials)

    def at_index(tree, i: int):
        return jax.tree.map(lambda v: np.asarray(v)[i], tree)

    return [
        Replay(*(at_index(v, i) for v in (worlds, trials, outcomes, trace.qpos, trace)))
        for i in range(count)
    ]
