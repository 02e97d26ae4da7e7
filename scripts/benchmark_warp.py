"""MuJoCo Warp on the same fields and controls: a GPU's graph of one step, launched repeatedly.

Importing this module needs the package `warp`; MJX brings MuJoCo Warp itself along.
"""
# pyright: reportInvalidTypeForm=false
# Warp's kernels declare their arrays by calls in annotations.

import copy
import time
from functools import partial
from importlib import import_module
from typing import Any

import jax
import mujoco
import numpy as np

from codesign_jax.model import ModelFields, compile_template, layout, mujoco_fields
from codesign_jax.scene import Scene
from codesign_jax.types import Trace

wp: Any = import_module("warp")
try:
    mjw: Any = import_module("mujoco_warp")
except ImportError:
    mjw = import_module("mujoco.mjx.third_party.mujoco_warp")

# Contacts and constraint rows that Warp allocates for each world.  Its documentation asks for as
# few as are never exceeded; Warp prints a warning if they are.
CONTACTS = 64
ROWS = 192
# Not in Warp's model: it derives the inertia of free bodies.
_ABSENT = ("dof_M0",)


@wp.kernel
def _count(step: wp.array(dtype=int)):
    step[0] = step[0] + 1


@wp.kernel
def _command(
    table: wp.array3d(dtype=float), step: wp.array(dtype=int), ctrl: wp.array2d(dtype=float)
):
    world, k = wp.tid()
    ctrl[world, k] = table[step[0], world, k]


@wp.func
def _missing(kappa: float, y: float):
    e = kappa * y
    return y * y * y * e * (3.0 + 2.0 * e) / (2.0 * (1.0 + e) * (1.0 + e))


@wp.kernel
def _soften(
    qpos: wp.array2d(dtype=float),
    dofs: wp.array2d(dtype=int),
    sections: wp.array2d(dtype=wp.vec4),
    stiffness: wp.array3d(dtype=float),
    applied: wp.array2d(dtype=float),
):
    """The formula of `codesign_jax.scene.beams.softening`, once for each bend joint."""
    world, finger, link = wp.tid()
    section = sections[world, finger]
    height = section[0]
    wall = section[1]
    inner = height - wall
    width = section[3]
    chamber = width - 2.0 * wall
    dof = dofs[finger, link]
    angle = qpos[world, dof]
    kappa = wp.max(angle / section[2], 0.0)
    second_moment = (width * height**3.0 - chamber * (inner**3.0 - wall**3.0)) / 3.0
    lacking = width * _missing(kappa, height)
    lacking -= chamber * (_missing(kappa, inner) - _missing(kappa, wall))
    moment = stiffness[world, finger, link] * angle * lacking / (4.0 * second_moment)
    applied[world, dof] = moment


@wp.kernel
def _velocity(
    qvel: wp.array2d(dtype=float), step: wp.array(dtype=int), out: wp.array3d(dtype=float)
):
    world = wp.tid()
    top = wp.float32(0.0)  # a plain literal would be a constant to Warp
    for i in range(qvel.shape[1]):
        value = wp.abs(qvel[world, i])
        if not (value <= top):
            top = value
    out[step[0], world, 2] = top


@wp.kernel
def _places(
    xipos: wp.array2d(dtype=wp.vec3),
    weights: wp.array(dtype=float),
    body: int,
    step: wp.array(dtype=int),
    out: wp.array3d(dtype=float),
):
    world = wp.tid()
    centre = wp.vec3(0.0, 0.0, 0.0)
    for i in range(weights.shape[0]):
        centre = centre + weights[i] * xipos[world, i]
    place = xipos[world, body]
    out[step[0], world, 0] = wp.length(place - centre)
    out[step[0], world, 1] = place[2]


class WarpProgram:
    """A rollout of worlds; has `compile_s` and `run` as `JaxProgram` of scripts.benchmark."""

    def __init__(self, scene: Scene, fields: ModelFields, ctrl: np.ndarray):
        """Puts model and data on the device and captures a step.

        Args:
          scene: The scene.
          fields: Model fields and start states, leading axis (world,).
          ctrl: Controls, shape (world, time, nu).
        """
        self.worlds, self.steps = ctrl.shape[:2]
        template = copy.deepcopy(compile_template(scene))
        lay = layout(scene)
        # Warp never resets a world and refuses the flag that asks for that.
        template.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        begin = time.perf_counter()
        arrays = jax.jit(jax.vmap(partial(mujoco_fields, scene.structure)))(fields)
        values = {k: np.asarray(v, np.float32) for k, v in arrays.of_model.items()}
        names = [n for n in values if n not in _ABSENT and not n.startswith("opt.")]
        self.model = mjw.put_model(template, dict.fromkeys(names, self.worlds))
        for name in names:
            self._assign(name, values[name])
        self._set_options({k: v for k, v in values.items() if k.startswith("opt.")})
        self.data = mjw.make_data(template, nworld=self.worlds, nconmax=CONTACTS, njmax=ROWS)
        self.start = wp.array(np.asarray(fields.start, np.float32), dtype=float)
        table = np.ascontiguousarray(np.moveaxis(np.asarray(ctrl, np.float32), 1, 0))
        self.table = wp.array(table, dtype=float)
        self.weights = wp.array(lay.centre_weights.astype(np.float32), dtype=float)
        self.body = int(lay.object)
        self.softens = scene.effects.neo_hookean
        if self.softens:
            self._prepare_softening(fields, lay.dofs[..., 0])
        self.index = wp.zeros(1, dtype=int)
        self.out = wp.zeros((self.steps, self.worlds, 3), dtype=float)
        self._reset()
        self._step()  # compiles the kernels
        with wp.ScopedCapture() as capture:
            self._step()
        self.graph = capture.graph
        wp.synchronize()
        self.compile_s = time.perf_counter() - begin

    def _assign(self, name: str, value: np.ndarray) -> None:
        array = getattr(self.model, name)
        array.assign(value.reshape(array.numpy().shape))

    def _set_options(self, options: dict[str, np.ndarray]) -> None:
        """Gives Warp the options of the worlds in place of the template's, which mean nothing."""
        gravity = options.pop("opt.gravity")
        impratio = options.pop("opt.impratio")
        self.model.opt.gravity = wp.array(gravity, dtype=wp.vec3)
        self.model.opt.impratio_invsqrt = wp.array(impratio**-0.5, dtype=float)
        if options:
            raise NotImplementedError(f"options of a world that Warp was not given: {[*options]}")

    def _prepare_softening(self, fields: ModelFields, dofs: np.ndarray) -> None:
        """Puts the numbers of `model.softening_moments` on the device."""
        if fields.tip is not None or fields.section is None:
            raise NotImplementedError("fingers whose section changes along them")
        sections = np.asarray(fields.section, np.float32)
        stiffness = np.asarray(fields.stiffness[..., 0], np.float32)
        self.dofs = wp.array(dofs.astype(np.int32), dtype=int)
        self.sections = wp.array(sections, dtype=wp.vec4)
        self.stiffness = wp.array(
            np.broadcast_to(stiffness, (self.worlds, *dofs.shape)), dtype=float
        )

    def _reset(self) -> None:
        self.index.zero_()
        self.out.zero_()
        for name in ("qvel", "qacc_warmstart", "time"):
            getattr(self.data, name).zero_()
        wp.copy(self.data.qpos, self.start)

    def _step(self) -> None:
        data = self.data
        at = self.index
        wp.launch(_command, data.ctrl.shape, [self.table, at], [data.ctrl])
        wp.launch(_velocity, self.worlds, [data.qvel, at], [self.out])
        if self.softens:
            given = [data.qpos, self.dofs, self.sections, self.stiffness]
            wp.launch(_soften, (self.worlds, *self.dofs.shape), given, [data.qfrc_applied])
        mjw.step(self.model, data)
        # Positions computed by a step belong to the state before it.
        wp.launch(_places, self.worlds, [data.xipos, self.weights, self.body, at], [self.out])
        wp.launch(_count, 1, [], [at])

    def run(self) -> tuple[Trace, float]:
        """Runs once; returns the trace, leading axes (world, time), and seconds."""
        self._reset()
        wp.synchronize()
        begin = time.perf_counter()
        for _ in range(self.steps):
            wp.capture_launch(self.graph)
        wp.synchronize()
        seconds = time.perf_counter() - begin
        out = np.array(np.moveaxis(self.out.numpy(), 0, 1))
        none = np.zeros((*out.shape[:2], 0), np.float32)
        return Trace(out[..., 0], out[..., 1], out[..., 2], none), seconds
