"""MuJoCo C in float64, the oracle: `mujoco.batch` on all cores, called from jitted programs."""

import threading

import jax
import mujoco
import mujoco.batch
import numpy as np

from codesign_jax.engines.base import refuse_hull, refuse_meshes
from codesign_jax.model import ModelFields, compile_template, layout
from codesign_jax.scene import Scene
from codesign_jax.types import Trace

# Steps between looking at the worlds: a lost object or a failed world stops being simulated at this
# grain.
_CHUNK = 25
_TIME = int(mujoco.mjtState.mjSTATE_TIME)


class MujocoEngine:
    """Runs worlds with MuJoCo C, whatever the float type of the caller.

    Worlds that are decided (the object is lost inside the cost window, or the world failed) are not
    simulated further; their remaining trace repeats its last entry.
    """

    name = "mujoco"

    def __init__(self, scene: Scene, *, num_threads: int = 0):
        """Prepares the engine.

        Args:
          scene: The scene.
          num_threads: Threads to use; 0 for all cores.
        """
        refuse_hull(scene, self.name)
        refuse_meshes(scene, self.name)
        self.scene = scene
        self.template = compile_template(scene)
        self.num_threads = num_threads
        self._batches: dict[int, mujoco.batch.Batch] = {}
        self._lock = threading.Lock()  # a Batch must not be used from several threads

    def rollout(self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False) -> Trace:
        """See `Engine.rollout`."""
        worlds, steps = ctrl.shape[:2]
        like = jax.ShapeDtypeStruct((worlds, steps), ctrl.dtype)
        nq = self.template.nq if trajectory else 0
        shapes = Trace(like, like, like, jax.ShapeDtypeStruct((worlds, steps, nq), ctrl.dtype))
        return jax.pure_callback(
            lambda f, c: self._run(f, c, trajectory), shapes, fields, ctrl, vmap_method="sequential"
        )

    def _run(self, fields: ModelFields, ctrl: jax.Array, trajectory: bool) -> Trace:
        dtype = np.asarray(ctrl).dtype
        fields = ModelFields(*(np.asarray(v, np.float64) for v in fields))
        with self._lock:
            trace = self._simulate(fields, np.asarray(ctrl, np.float64), trajectory)
        return Trace(*(v.astype(dtype) for v in trace))

    def _batch(self, num_worlds: int) -> mujoco.batch.Batch:
        if num_worlds not in self._batches:
            self._batches[num_worlds] = mujoco.batch.Batch(
                self.template, num_worlds, self.num_threads
            )
        return self._batches[num_worlds]

    def _simulate(self, fields: ModelFields, ctrl: np.ndarray, trajectory: bool) -> Trace:
        (worlds, steps), scene, nq = ctrl.shape[:2], self.scene, self.template.nq
        batch = self._batch(worlds)
        write_fields(batch, fields)
        distance, height, speed = np.zeros((3, worlds, steps))
        trace = Trace(distance, height, speed, np.zeros((worlds, steps, nq * trajectory)))
        start, end = (round(t / scene.discretization.timestep) for t in scene.window)
        going = np.arange(worlds)
        for first in range(0, steps, _CHUNK):
            part = slice(first, min(first + _CHUNK, steps))
            new, taken = self._advance(batch, going, ctrl[going, part], trajectory)
            for array, values in zip(trace, new, strict=True):
                array[going, part] = values
            # The cost window's end counts as lost only strictly inside it, as in `cost.outcome`.
            time = np.arange(part.start, part.stop)
            lost = (new.distance >= scene.cost.lost_distance) & (time >= start) & (time < end)
            failed = ~np.isfinite(new.speed) | (new.speed > scene.limits.speed)
            # MuJoCo warned (a bad control, state or inertia, a full contact list) and stopped.
            stopped = batch.warning[going, :, 0].any(1)
            done = lost.any(1) | failed.any(1) | (new.height < -scene.limits.penetration).any(1)
            done |= stopped
            for array in trace:
                array[going[done], part.stop :] = array[going[done], part.stop - 1][:, None]
            for world, count in zip(going[stopped], taken[stopped], strict=True):
                trace.speed[world, first + count :] = np.nan
            going = going[~done]
            if not going.size:
                break
        return trace

    def _advance(
        self, batch: mujoco.batch.Batch, ids: np.ndarray, ctrl: np.ndarray, trajectory: bool
    ) -> tuple[Trace, np.ndarray]:
        """Steps the given worlds through a chunk.

        Returns:
          The chunk's trace, whose entry k describes the state before step k, and the steps taken by
          each world: fewer than asked for where MuJoCo stopped.
        """
        lay = layout(self.scene)
        before = batch.bind("qvel")[ids][:, None], batch.bind("qpos")[ids][:, None]
        record = batch.rollout(
            ctrl.shape[1],
            ctrl,
            control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
            record=("xipos", "qvel", _TIME, *(("qpos",) if trajectory else ())),
            ids=ids,
        )
        # Where a world stopped, its records repeat, and so does their time.
        taken = 1 + np.count_nonzero(np.diff(record[_TIME][..., 0], axis=1), axis=1)
        xipos = record["xipos"]
        centre = np.tensordot(xipos, lay.centre_weights, axes=(2, 0))
        middle = xipos[:, :, lay.object]
        # Records of state follow the step, derived fields precede it: shift the former by one.
        qvel = np.concatenate([before[0], record["qvel"][:, :-1]], 1)
        with np.errstate(invalid="ignore"):
            speed = np.abs(qvel).max(-1)
        qpos = (
            np.concatenate([before[1], record["qpos"][:, :-1]], 1)
            if trajectory
            else xipos[:, :, 0, :0]
        )
        distance = np.linalg.norm(middle - centre, axis=-1)
        return Trace(distance, middle[..., 2], speed, qpos), taken


def write_fields(batch: mujoco.batch.Batch, fields: ModelFields) -> None:
    """Gives every simulation of a batch its model fields and start state."""
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    for name in ModelFields._fields:
        if name == "start":
            batch.bind("qpos")[:] = fields.start
        else:
            batch.expand(name)[:] = getattr(fields, name)
    batch.bind("qacc_warmstart")[:] = 0.0


def world_model(scene: Scene, fields: ModelFields) -> mujoco.MjModel:
    """Returns an MjModel with the fields of one world, for a viewer or any mj_ function."""
    import copy

    model = copy.deepcopy(compile_template(scene))
    for name in ModelFields._fields:
        if name != "start":
            getattr(model, name)[:] = np.asarray(getattr(fields, name), np.float64)
    return model
