"""Runs worlds in MuJoCo C or the structured engine behind one interface, for the hard cases."""

import contextlib
import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import model, scene
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import Scene
from tests.helpers import grasps, oracles

FIRM = scene.load("paper").contact
"""Contact of the standard scene: its stiffness and impratio were chosen against creep."""

CREEP = 5e-5
"""Speed [m/s] at which a held object may creep: 0.05 mm/s."""

CHUNK = 50
"""Steps that a compiled program of the structured engine takes."""


class History(NamedTuple):
    """States after every step: qpos (world, time, nq) and qvel (world, time, nv)."""

    qpos: np.ndarray
    qvel: np.ndarray

    @property
    def object(self) -> np.ndarray:
        """Position of the object, (world, time, 3)."""
        return self.qpos[..., -7:-4]

    @property
    def object_velocity(self) -> np.ndarray:
        """Linear velocity of the object, (world, time, 3)."""
        return self.qvel[..., -6:-3]

    @property
    def speed(self) -> np.ndarray:
        """Largest absolute velocity of each step, (world, time)."""
        return np.abs(self.qvel).max(-1)


def refined(base: Scene, step: float) -> Scene:
    """The scene with its time step times a factor."""
    h = base.discretization.timestep * step
    return dataclasses.replace(
        base, discretization=dataclasses.replace(base.discretization, timestep=h)
    )


def scene_of(name, hand_name=None, **settings) -> Scene:
    """A built-in scene, with settings `table__entry`.

    What is compared with MuJoCo C, that is `paper_spheres`, is solved as closely as C solves it;
    the default scene is solved as users have it.
    """
    if name == "paper_spheres":
        settings = {"newton__decrement": 1e-6} | settings
    return scene.load(name, hand_name=hand_name, overrides=grasps.overrides_of(settings))


@functools.cache
def pinch(name="paper_spheres", **settings) -> Scene:
    """Two opposed fingers of three links and the paper's three objects."""
    settings = {"discretization__links": 3} | settings
    return scene_of(name, hand_name=grasps.DATA / "pinch.toml", **settings)


@functools.lru_cache(maxsize=8)
def bench(
    base: Scene, engine: str, step: float, precision: str, tolerance: float | None = None
) -> "Bench":
    """The bench of a scene, engine, time step and precision; compiled once while in use.

    The structured engine stops at a Newton decrement of `tolerance`, by default the scene's.
    Only the last few are kept: XLA's programs take 1,200 memory maps each, of 65,530 that Linux
    gives a process, and at the limit XLA aborts (docs/notes/structured-engine.md).
    """
    return Bench(refined(base, step), engine, precision, tolerance)


@contextlib.contextmanager
def floats(wide: bool):
    """Float64 or float32 by default.

    JAX keeps what it made of a long-lived NumPy array of indices, in the width of that time: the
    layout's are made anew.
    """
    model.layout.cache_clear()
    with jax.enable_x64(wide), jax.default_matmul_precision("highest"):
        yield
    model.layout.cache_clear()


class Bench:
    """A scene in one engine and precision."""

    def __init__(
        self, the_scene: Scene, engine: str, precision: str, tolerance: float | None = None
    ):
        self.scene = the_scene
        self.limits: dict = {}
        if tolerance is not None:  # as far as rounding allows
            self.limits = {"tolerance": tolerance, "iterations": 100, "evaluations": 40}
        self.engine = engine
        self.wide = precision == "float64"
        assert self.wide or engine == "structured"  # MuJoCo C is built for float64
        self.h = the_scene.discretization.timestep

    def fields(self, params, trials):
        """Model fields of worlds, float64 NumPy arrays with a leading world axis."""
        with floats(True):
            worlds = zip(*(jax.tree.map(jnp.asarray, v) for v in (params, trials)), strict=True)
            batch = [grasps.world_inputs(self.scene, p, t)[0] for p, t in worlds]
            return jax.tree.map(lambda *v: np.stack(v), *batch)

    def commands(self, params, trials) -> np.ndarray:
        """The grasp's controls, (world, time, nu)."""
        with floats(True):
            worlds = zip(*(jax.tree.map(jnp.asarray, v) for v in (params, trials)), strict=True)
            return np.stack([grasps.world_inputs(self.scene, p, t)[1] for p, t in worlds])

    def hold(self, seconds: float, *rows) -> np.ndarray:
        """Constant controls, a row for each world, (world, time, nu)."""
        return np.repeat(np.stack(rows)[:, None], round(seconds / self.h), 1)

    def run(self, fields, ctrl, qpos=None, qvel=None, masses=None) -> History:
        """Steps worlds from a state, the fields' start at rest if none is given.

        Args:
          fields: See `fields`.
          ctrl: Controls, (world, time, nu).
          qpos: Start positions (world, nq).
          qvel: Start velocities (world, nv).
          masses: Factors on the object's mass, one for each chunk of `CHUNK` steps.
        """
        worlds = len(ctrl)
        qpos = fields.start if qpos is None else np.asarray(qpos)
        qvel = np.zeros((worlds, qpos.shape[1] - 1)) if qvel is None else np.asarray(qvel)
        if self.engine == "mujoco":
            return self._mujoco(fields, ctrl, qpos, qvel, masses)
        path, (last, speed) = self._structured(fields, ctrl, qpos, qvel, masses)
        return History(
            np.concatenate([path.qpos[:, 1:], last], 1),
            np.concatenate([path.qvel[:, 1:], speed], 1),
        )

    def path(self, fields, ctrl) -> oracles.Path:
        """States before every step of the structured engine, from the fields' start at rest."""
        qvel = np.zeros((len(ctrl), fields.start.shape[1] - 1))
        return self._structured(fields, ctrl, fields.start, qvel)[0]

    def _mujoco(self, fields, ctrl, qpos, qvel, masses) -> History:
        out = []
        for w in range(len(ctrl)):
            compiled = world_model(self.scene, grasps.nth(fields, w))
            data = mujoco.MjData(compiled)
            rows = []
            data.qpos[:] = qpos[w]
            data.qvel[:] = qvel[w]
            properties = compiled.body_mass[-1], compiled.body_inertia[-1].copy()
            for k, u in enumerate(ctrl[w]):
                if masses is not None and k % CHUNK == 0:
                    factor = masses[k // CHUNK]
                    compiled.body_mass[-1], compiled.body_inertia[-1] = (
                        factor * v for v in properties
                    )
                    compiled.dof_M0[-6:-3], compiled.dof_M0[-3:] = (factor * v for v in properties)
                data.ctrl[:] = u
                oracles.soften(self.scene, grasps.nth(fields, w), compiled, data)
                mujoco.mj_step(compiled, data)
                rows.append((data.qpos.copy(), data.qvel.copy()))
            out.append([np.stack(v) for v in zip(*rows, strict=True)])
        return History(*(np.stack(v) for v in zip(*out, strict=True)))

    def _structured(self, fields, ctrl, qpos, qvel, masses=None) -> tuple[oracles.Path, tuple]:
        """States before every step, and (qpos, qvel) after the last one, (world, 1, ...)."""
        dtype = jnp.float64 if self.wide else jnp.float32
        with floats(self.wide):
            numbers = fields._replace(start=qpos, shape=None)
            numbers = jax.tree.map(lambda v: np.asarray(v, dtype), numbers)
            fields = numbers._replace(shape=fields.shape)  # an index stays an integer
            count = ctrl.shape[1]
            start, advance = self._program
            hand, state = start(fields, jnp.asarray(qvel, dtype))
            ctrl = np.concatenate([ctrl, np.repeat(ctrl[:, -1:], -count % CHUNK, 1)], 1)
            rows = []
            for first in range(0, ctrl.shape[1], CHUNK):
                part = jnp.asarray(ctrl[:, first : first + CHUNK], dtype)
                if masses is not None:
                    heavier = loaded(fields, masses[first // CHUNK])
                    hand = start(heavier, jnp.asarray(qvel, dtype))[0]
                *row, state = advance(hand, state, part)
                rows.append([np.asarray(v, np.float64) for v in row])
            rows = [np.concatenate(v, 1) for v in zip(*rows, strict=True)]
        after = tuple(v[:, count - 1 : count] for v in rows[4:])
        return oracles.Path(*(v[:, :count] for v in rows[:4])), after

    @functools.cached_property
    def _program(self):
        """Compiled start, and compiled chunk of steps."""
        engine = StructuredEngine(self.scene, **self.limits)

        def start(fields, qvel):
            return world_constants(self.scene, fields), moving(engine, fields, qvel)

        def advance(hand, state, ctrl):
            outputs, end = engine.advance(hand, state, ctrl)
            last = engine.qpos(end)[:, None], engine.qvel(end)[:, None]
            before = [outputs[name] for name in oracles.Path._fields]
            after = [
                jnp.concatenate([a[:, 1:], b], 1) for a, b in zip(before[:2], last, strict=True)
            ]
            return *before, *after, end

        return jax.jit(start), jax.jit(advance)


def loaded(fields, factor):
    """Fields, NumPy arrays, whose object is heavier by a factor."""
    heavier = {n: np.array(getattr(fields, n)) for n in ("object_mass", "object_inertia")}
    return fields._replace(**{name: factor * value for name, value in heavier.items()})


def moving(engine: StructuredEngine, fields, qvel):
    """Start states of fields with velocities (world, nv)."""
    return engine.state_at(engine.reset(fields), fields.start, qvel)
