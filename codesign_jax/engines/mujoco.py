"""MuJoCo C in float64, the oracle: `mujoco.batch` on all cores, called from jitted programs."""

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from codesign_jax.engines.base import Bodies, Equal, refuse_forces, refuse_meshes
from codesign_jax.engines.structured import bodies
from codesign_jax.judge import verdict
from codesign_jax.model import (
    ModelFields,
    compile_template,
    layout,
    mujoco_fields,
    section_springs,
    softening_moments,
    split,
)
from codesign_jax.model.layout import centre_weights
from codesign_jax.scene import Scene, effects
from codesign_jax.types import Forces, Status, Trace

# Steps between looking at the worlds: a lost object or a failed world stops being simulated at this
# grain.
_CHUNK = 25
_TIME = int(mujoco.mjtState.mjSTATE_TIME)
_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


class MujocoEngine(Equal):
    """Runs worlds with MuJoCo C, whatever the float type of the caller.

    Worlds that are decided, see `verdict`, are not simulated further.
    """

    name = "mujoco"
    fills = True  # see `Engine`

    def __init__(self, scene: Scene, *, num_threads: int = 0):
        """Prepares the engine."""
        refuse_meshes(scene, self.name)
        effects.refuse(scene.effects, self.name)
        self.scene = scene
        self.template = compile_template(scene)
        self.num_threads = num_threads
        self._batches: dict[int, mujoco.batch.Batch] = {}
        self._lock = threading.Lock()  # a Batch must not be used from several threads

    def _key(self) -> tuple:
        return self.scene.structure, self.num_threads

    def observe(self, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
        return bodies.observer(self.scene, fields)

    def contacts(
        self, fields: ModelFields, state: jax.Array, pressure: jax.Array, *, find: bool = True
    ) -> Forces:
        refuse_forces(self.name)

    def rollout(self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False) -> Trace:
        """See `Engine.rollout`."""
        worlds, steps = ctrl.shape[:2]
        nq, nv = (self.template.nq, self.template.nv)
        like = jax.ShapeDtypeStruct((worlds, steps), ctrl.dtype)
        shapes = Trace(
            like,
            like,
            like,
            jax.ShapeDtypeStruct((worlds, steps, nq * trajectory), ctrl.dtype),
            jax.ShapeDtypeStruct((worlds, steps), np.int32),
            jax.ShapeDtypeStruct((worlds, nq + 2 * nv + 3), ctrl.dtype),
        )
        # One array of all constants: each argument is an array for XLA to fill.
        constants = jnp.stack([jnp.asarray(v) for v in jax.tree.leaves(fields.constants)], 1)
        inputs = (
            fields._replace(constants=()),
            constants,
            _bounds(fields.constants),
            ctrl,
        )
        run = partial(self._run, trajectory)
        return jax.pure_callback(run, shapes, *inputs, vmap_method="sequential")

    def _run(
        self,
        trajectory: bool,
        fields: ModelFields,
        constants: jax.Array,
        bounds: verdict.Bounds,
        ctrl: jax.Array,
    ) -> Trace:
        dtype = np.asarray(ctrl).dtype
        inputs = (fields, constants, bounds, ctrl)
        fields, numbers, bounds, wide = jax.tree.map(lambda v: np.asarray(v, np.float64), inputs)
        tree = jax.tree.structure(self.scene.bare)
        fields = fields._replace(constants=jax.tree.unflatten(tree, list(numbers.T)))
        with self._lock:
            trace = self._simulate(fields, bounds, wide, trajectory)
        return jax.tree.map(lambda v: v if v.dtype == np.int32 else v.astype(dtype), trace)

    def _batch(self, num_worlds: int) -> mujoco.batch.Batch:
        if num_worlds not in self._batches:
            self._batches[num_worlds] = mujoco.batch.Batch(
                self.template, num_worlds, self.num_threads
            )
        return self._batches[num_worlds]

    def _simulate(
        self,
        fields: ModelFields,
        bounds: verdict.Bounds,
        ctrl: np.ndarray,
        trajectory: bool,
    ) -> Trace:
        scene = self.scene
        worlds, steps = ctrl.shape[:2]
        batch = self._batch(worlds)
        write_fields(scene, batch, fields)
        rollout = _ChunkedRollout(scene, fields, bounds, steps, to_end=trajectory)
        weights = centre_weights(layout(scene), fields.share)
        batch.bind("qacc_warmstart")[:] = rollout.start.acc
        # Moments that change with every step
        chunk = 1 if scene.effects.neo_hookean else _CHUNK
        first = 0
        while first < steps and rollout.going.size:
            # Worlds that are decided when they start, as those that fill a batch, leave at once.
            length = chunk if first or rollout.start.going.all() else 1
            part = slice(first, min(first + length, steps))
            going = rollout.going
            if fields.law is not None:
                _apply_section(scene, batch, fields, going, ctrl[going, first, 6:])
            elif scene.effects.neo_hookean:
                _apply_softening(scene, batch, fields, going)
            middle = weights[going]
            new, taken, states = self.advance(batch, going, ctrl[going, part], middle, trajectory)
            stopped = rollout.store(part, new, taken, batch.warning[going, :, 0])
            rollout.decide(part, new, states, stopped)
            first = part.stop
        names = ("qpos", "qvel", "qacc_warmstart")
        return rollout.trace(*(batch.bind(name)[rollout.going] for name in names))

    def advance(
        self,
        batch: mujoco.batch.Batch,
        ids: np.ndarray,
        ctrl: np.ndarray,
        weights: np.ndarray,
        trajectory: bool,
    ) -> tuple[Trace, np.ndarray, np.ndarray]:
        """Steps the given worlds, with their bodies' weights in the hand's centre, through a chunk.

        Returns the chunk's trace, whose entry k describes the state before step k; the steps taken
        by each world, fewer than asked for where MuJoCo stopped; and qpos and qvel of those states.
        """
        lay = layout(self.scene)
        before = batch.bind("qvel")[ids][:, None], batch.bind("qpos")[ids][:, None]
        record, raised = _rollout(batch, ids, ctrl)
        # Where a world stopped, its records repeat, and so does their time.
        taken = 1 + np.count_nonzero(np.diff(record[_TIME][..., 0], axis=1), axis=1)
        taken[raised] = 0
        xipos = record["xipos"]
        centre = np.einsum("wtbx,wb->wtx", xipos, weights)
        middle = xipos[:, :, lay.object]
        # Records of state follow the step, derived fields precede it: shift the former by one.
        qvel = np.concatenate([before[0], record["qvel"][:, :-1]], 1)
        with np.errstate(invalid="ignore"):
            speed = np.abs(qvel).max(-1)
        qpos = np.concatenate([before[1], record["qpos"][:, :-1]], 1)
        distance = np.linalg.norm(middle - centre, axis=-1)
        capped = record["solver_niter"].max(-1) >= self.scene.solver.iterations
        status = np.where(capped, int(Status.SOLVER_CAP), 0)
        status[raised, 0] |= int(Status.CONTACT_OVERFLOW)
        kept = qpos if trajectory else qpos[..., :0]
        states = np.concatenate([qpos, qvel], -1)
        return Trace(distance, middle[..., 2], speed, kept, status), taken, states


_bounds = jax.jit(verdict.bounds)


class _ChunkedRollout:
    """The trace of a batch of worlds, which grows chunk by chunk until all worlds are decided.

    Attributes:
      start: The state in which the worlds start.
      going: Indices of the worlds that are not decided, shape (world,).
      last: `Trace.last`, shape (world, n); `end`: its parts, which are views of it.
    """

    def __init__(
        self,
        scene: Scene,
        fields: ModelFields,
        bounds: verdict.Bounds,
        steps: int,
        *,
        to_end: bool,
    ):
        """Begins a rollout.

        Args:
          bounds: Bounds of the worlds, of shape (world,).
          steps: Number of time steps.
          to_end: Whether qpos is kept, and worlds that lost their object go on.
        """
        self.start = split(scene, fields.start)
        self.last = np.concatenate(self.start, 1)
        self.end = split(scene, self.last)
        self.steps = steps
        self.to_end = to_end
        self._bounds = verdict.Bounds(*(v[:, None] for v in bounds))
        worlds = len(self.last)
        self.going = np.arange(worlds)
        self.distance, self.height, self.speed = np.zeros((3, worlds, steps))
        self.status = np.zeros((worlds, steps), np.int32)
        self.qpos = np.zeros((worlds, steps, self.start.qpos.shape[1] * to_end))

    def store(self, part: slice, new: Trace, taken: np.ndarray, warnings: np.ndarray) -> np.ndarray:
        """Stores the entries of a chunk; returns which worlds MuJoCo stopped, bool (world,).

        Args:
          part: Its steps.
          new: Its trace, of the worlds that were going; `taken`: the steps that each has taken.
          warnings: MuJoCo's warnings so far, shape (world, kind).
        """
        # MuJoCo warned (a bad control, state or inertia, a full contact list) and stopped.
        stopped = warnings.any(1) | (taken == 0)
        count = part.stop - part.start
        new.speed[stopped[:, None] & (np.arange(count) >= taken[:, None])] = np.nan
        series = self._series()
        for array, values in zip(series, new[: len(series)], strict=True):
            array[self.going, part] = np.asarray(values)
        full = warnings[:, _FULL].any(1)
        overflow = int(Status.CONTACT_OVERFLOW)
        self.status[self.going[full], part.start + taken[full] - 1] |= overflow
        return stopped

    def decide(self, part: slice, new: Trace, states: np.ndarray, stopped: np.ndarray) -> None:
        """Ends the worlds that a chunk decides; arguments as in `store`, and qpos and qvel."""
        first = part.start
        count = part.stop - first
        going = self.going
        step = self.start.step[going] + first
        entry, kept = _decisions(self._bounds_of(going), new, step, to_end=self.to_end)
        if not first:
            stay = self.start.going[:, 0] == 0  # decided before this rollout
            entry[stay] = 0
            kept[stay] = 0
            self.speed[stay, 0] = self.start.speed[stay, 0]
            self.status[stay, 0] = 0
        sound = kept >= 0
        self.last[going[sound], : states.shape[-1]] = states[sound, kept[sound]]
        done = (entry < count) | stopped
        for world, at, state in zip(going[done], entry[done], kept[done], strict=True):
            self._repeat(world, first + at, first + state, decided=at < count)
        self.going = going[~done]

    def _repeat(self, world: int, entry: int, kept: int, *, decided: bool) -> None:
        """Repeats the state of a world that has ended.

        Args:
          entry: The entry that decides it, or the first one behind the chunk.
          kept: The entry whose state it keeps, -1 for the start of the rollout.
          decided: Whether there is such an entry; False if MuJoCo stopped behind the chunk.
        """
        rest = slice(entry, None)
        for array in (self.distance, self.height, self.qpos):
            array[world, rest] = array[world, max(kept, 0)]
        # What MuJoCo told of the deciding step stays, also where its state does not.
        self.status[world, rest] = self.status[world, entry if decided else kept]
        speed = self.speed[world, entry] if decided else np.nan
        self.speed[world, rest] = speed
        self.end.speed[world] = speed
        self.end.acc[world] = 0
        self.end.going[world] = 0

    def trace(self, qpos: np.ndarray, qvel: np.ndarray, acc: np.ndarray) -> Trace:
        """The whole trace, given the states of the worlds that are still going."""
        going = self.going
        speed = np.abs(qvel).max(1, keepdims=True)
        self.end.speed[going] = speed
        state = np.concatenate([qpos, qvel, acc], 1)
        good = np.isfinite(state).all(1) & verdict.slow(self._bounds_of(going), speed)[:, 0]
        self.last[going[good], : state.shape[1]] = state[good]
        self.end.going[going] = good[:, None]
        self.end.step[:] = self.start.step + self.steps
        return Trace(*self._series(), self.last)

    def _series(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The trace's entries of every step, in its order."""
        return self.distance, self.height, self.speed, self.qpos, self.status

    def _bounds_of(self, worlds: np.ndarray) -> verdict.Bounds:
        return verdict.Bounds(*(v[worlds] for v in self._bounds))


def _decisions(
    bounds: verdict.Bounds, new: Trace, first: np.ndarray, *, to_end: bool
) -> tuple[np.ndarray, np.ndarray]:
    """When worlds are decided within a chunk, and where they stay.

    Args:
      bounds: Bounds of the worlds, of shape (world, 1).
      new: The chunk's trace, arrays of shape (world, step).
      first: Index of each world's first step, shape (world, 1).

    Returns:
      Index of the entry that decides each world, or the number of entries, and of the entry whose
      state it keeps: the same one, or the one before if the state is no good; shape (world,).
    """
    count = new.speed.shape[1]
    entries = new.distance, new.height, new.speed
    goes_on = verdict.goes_on(bounds, *entries, first + np.arange(count), to_end=to_end)
    entry = np.where(goes_on.all(1), count, goes_on.argmin(1))
    at = np.minimum(entry, count - 1)[:, None]
    distance, speed = (np.take_along_axis(v, at, 1)[:, 0] for v in (new.distance, new.speed))
    good = (entry < count) & verdict.slow(bounds, speed[:, None])[:, 0] & (distance <= verdict.FAR)
    return entry, np.where(good, entry, entry - 1)


def _rollout(
    batch: mujoco.batch.Batch, ids: np.ndarray, ctrl: np.ndarray
) -> tuple[dict, np.ndarray]:
    """Records of a chunk, and which worlds MuJoCo gave up for want of memory, shape (world,) bool.

    Contacts, constraints and solver share one arena.  Where it is full MuJoCo leaves out contacts
    and warns, or raises; records of the latter worlds are not numbers.
    """
    m = batch.model
    shape = (len(ids), ctrl.shape[1])
    names = {"xipos": (m.nbody, 3), "qvel": (m.nv,), "qpos": (m.nq,), _TIME: (1,)}
    record = {name: np.full((*shape, *size), np.nan) for name, size in names.items()}
    record["solver_niter"] = np.zeros((*shape, mujoco.mjNISLAND), np.int32)
    raised = np.zeros(len(ids), bool)
    try:
        batch.rollout(
            ctrl.shape[1],
            ctrl,
            control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
            record=tuple(record),
            ids=ids,
            out=record,
        )
    except mujoco.batch.SimulationError as error:
        raised = np.isin(ids, error.ids)
        if not all("out of memory" in str(batch.error(int(i))) for i in error.ids):
            raise
        for values in (v for v in record.values() if v.dtype != np.int32):
            values[raised] = np.nan
    return record, raised


def _apply_softening(
    scene: Scene, batch: mujoco.batch.Batch, fields: ModelFields, ids: np.ndarray
) -> None:
    bend = layout(scene).dofs[..., 0]
    angles = batch.bind("qpos")[ids][:, bend]
    mine = jax.tree.map(lambda v: v[ids], fields._replace(constants=()))
    batch.bind("qfrc_applied")[ids[:, None, None], bend] = softening_moments(scene, mine, angles)


def _apply_section(
    scene: Scene, batch: mujoco.batch.Batch, fields: ModelFields, ids: np.ndarray, pressure: Any
) -> None:
    """Gives joints the moments of their sections, and the springs that are implicit there."""
    dofs = layout(scene).dofs
    mine = jax.tree.map(lambda v: v[ids], fields._replace(constants=()))
    springs = section_springs(scene, mine, batch.bind("qpos")[ids][:, dofs], pressure)
    arrays = (
        batch.bind("qfrc_applied"),
        batch.expand("dof_damping"),
        batch.expand("dof_armature"),
    )
    for array, values in zip(arrays, springs, strict=True):
        array[ids[:, None, None, None], dofs] = values


def write_fields(scene: Scene, batch: mujoco.batch.Batch, fields: ModelFields) -> None:
    """Gives every simulation of a batch its model fields and start state.

    Each model is computed once: what fills up a batch has that of another world.
    """
    rows, place = _models(fields)
    worlds = [jax.tree.map(lambda v, w=w: v[w], fields) for w in rows]
    models = [mujoco_fields(scene, world, np).of_model for world in worlds]
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    batch.bind("qpos")[:] = fields.qpos
    batch.bind("qvel")[:] = fields.qvel
    for name in models[0]:
        batch.expand(name)[:] = np.stack([model[name] for model in models])[place]
    batch.bind("qacc_warmstart")[:] = 0.0


def _models(fields: ModelFields) -> tuple[np.ndarray, np.ndarray]:
    """A world with each different model, and the place of each world's model among them."""
    numbers = jax.tree.leaves(fields._replace(start=()))
    every = np.concatenate([v.reshape(len(v), -1) for v in numbers], 1)
    _, rows, place = np.unique(every, axis=0, return_index=True, return_inverse=True)
    return rows, place.ravel()


def world_model(scene: Scene, fields: ModelFields) -> mujoco.MjModel:
    """Returns an MjModel with the fields of one world, for a viewer or any mj_ function."""
    import copy

    model = copy.deepcopy(compile_template(scene))
    wide = jax.tree.map(lambda v: np.asarray(v, np.float64), fields)
    arrays = mujoco_fields(scene, wide, np)
    for name, value in arrays.of_model.items():
        if name == "opt.impratio":
            model.opt.impratio = float(value)
        elif name == "opt.gravity":
            model.opt.gravity[:] = value
        else:
            getattr(model, name)[:] = value
    return model
