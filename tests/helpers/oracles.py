"""Steps of the structured engine's kernel, checked one by one against what it does not share.

Every step of a path is compared at the state that the kernel itself went through, so that chaos
does not enter, and a whole grasp is one program.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import assembly, coordinates
from codesign_jax.engines.structured.lanes import dot, once, sum_axis, sum_fingers
from codesign_jax.engines.structured.laws.contact import Contacts, constraint_update
from codesign_jax.engines.structured.laws.kinematics import Acc
from codesign_jax.engines.structured.linear.tree import (
    Forces,
    Problem,
    Spatial,
    propagate,
    relative,
)
from codesign_jax.engines.structured.world_model import world_constants
from tests.helpers import grasps

FLOOR = 100.0
"""Smallest scale of relative errors of accelerations, ten g: at rest they are rounding."""


class Path(NamedTuple):
    """States of worlds, float64: qpos, qvel, acc (world, time, ...), distance (world, time)."""

    qpos: np.ndarray
    qvel: np.ndarray
    acc: np.ndarray
    distance: np.ndarray


def path(engine, fields, ctrl):
    """The kernel's path under controls (world, time, nu), whatever becomes of the worlds."""

    @jax.jit
    def run(fields, ctrl):
        state = engine.reset(fields)
        return engine.advance(world_constants(engine.scene, fields), state, ctrl)[0]

    found = run(fields, jnp.asarray(ctrl))
    return Path(*(np.asarray(found[name]) for name in Path._fields))


def against_mujoco(scene, fields, ctrl, found, stride=1):
    """Errors of a path's steps against MuJoCo C, which converges at each of its states.

    Relative ones of accelerations, of distances [m], and numbers of contacts, (world, state). The
    start is left out: there the object is so exactly on the table that rounding decides whether
    it touches.
    """
    h, lay = scene.discretization.timestep, model.layout(scene)
    errors, far, touching = [], [], []
    for world in range(len(ctrl)):
        own = grasps.nth(fields, world)
        compiled = world_model(scene, own)
        compiled.opt.tolerance, compiled.opt.iterations, compiled.opt.ls_iterations = 0.0, 200, 50
        data = mujoco.MjData(compiled)
        for k in range(1, ctrl.shape[1] - 1, stride):
            qpos, (qvel, after) = found.qpos[world, k], found.qvel[world, k : k + 2]
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl[world, k]
            soften(scene, own, data)
            mujoco.mj_forward(compiled, data)
            scale = max(np.linalg.norm(data.qacc), FLOOR)
            errors.append(np.linalg.norm((after - qvel) / h - data.qacc) / scale)
            away = data.xipos[lay.object] - lay.centre_weights @ data.xipos
            far.append(abs(np.linalg.norm(away) - found.distance[world, k]))
            touching.append(data.ncon)
    return (np.array(v).reshape(len(ctrl), -1) for v in (errors, far, touching))


def soften(scene, fields, data):
    """What the engine `mujoco` applies before a step."""
    if scene.effects.neo_hookean:
        bend = model.layout(scene).dofs[..., 0]
        data.qfrc_applied[bend] = model.softening_moments(scene, fields, data.qpos[bend])


def unbalanced(scene, fields, ctrl, found, stride):
    """Forces that a path's accelerations leave unbalanced: the gradient of a step's objective.

    Plain JAX over whole arrays: no Newton iteration, no elimination and no memory of the kernel,
    whose functions of geometry and friction cone alone are shared. The largest on wrist, joints and
    object, each over the largest of all states if nothing were accelerated, shape (3, state).
    """
    times = slice(None, None, stride)
    states = [v[:, times] for v in (found.qpos, found.qvel, found.acc, ctrl)]
    count = states[0].shape[1]
    qpos, qvel, acc, u = (jnp.asarray(v.reshape(-1, v.shape[-1])) for v in states)
    many = jax.tree.map(lambda v: np.repeat(np.asarray(v), count, 0), fields)

    @jax.jit
    def force(many, qpos, qvel, acc, u):
        state = coordinates.make(scene, qpos, qvel, acc)
        given = assembly.problem(scene, world_constants(scene, many), state, u.T)

        def power(virtual: Acc, acc: Acc):
            return residual_power(*given, acc, virtual).sum()

        none = jax.tree.map(jnp.zeros_like, state.acc)
        # Power is linear in the virtual accelerations: its slope is the force itself.
        return [jax.grad(power)(none, a) for a in (state.acc, none)]

    left, all_of_it = force.lower(many, qpos, qvel, acc, u).compile(
        {"xla_backend_optimization_level": 0}
    )(many, qpos, qvel, acc, u)
    worst = [[np.abs(v).reshape(-1, len(qpos)).max(0) for v in f] for f in (left, all_of_it)]
    # At rest nothing is accelerated, and what is left is rounding of forces that cancel.
    return np.array(worst[0]) / np.max(worst[1], axis=1, keepdims=True)


def residual_power(problem: Problem, velocity: Spatial, acc: Acc, virtual: Acc) -> jax.Array:
    """Power lambda' F of the unbalanced forces at acc along virtual, shape (1, world)."""
    if problem.palm_acc is not None:  # data of the step, not a solution
        acc = acc._replace(wrist=problem.palm_acc)
    motion = propagate(problem.kin, acc)
    along = propagate(problem.kin, virtual)
    inertial = inertial_forces(problem, acc, motion)
    force = Forces(*(m - s for m, s in zip(inertial, problem.smooth, strict=True)))
    power = inner(force, virtual, along)
    for name, c in problem.contacts.items():

        def pushed(c: Contacts, motion: Spatial, velocity: Spatial, along: Spatial, name=name):
            force = constraint_update(c, _jar(name, c, motion, velocity)).force
            each = dot(force, c.relative(relative(name, along)))
            return each.reshape(-1, each.shape[-1]).sum(0, keepdims=True)

        power = power - once(pushed, c, motion, velocity, along)
    return power


def _jar(name: str, c: Contacts, motion: Spatial, velocity: Spatial) -> jax.Array:
    """J a - aref of a set of contacts."""
    speed = c.relative(relative(name, velocity))
    return c.relative(relative(name, motion)) - c.reference(speed)


def inertial_forces(problem: Problem, acc: Acc, motion: Spatial) -> Forces:
    """M a in factored form: spatial forces of the bodies and armature forces of the joints."""
    body, hand = problem.body, problem.hand
    moves = problem.palm_acc is None
    return Forces(
        body.palm.times(motion.palm),
        once(lambda b, m: b.times(m), body.link, motion.link),
        body.object.times(motion.object),
        hand.wrist_armature * acc.wrist if moves else jnp.zeros_like(acc.wrist),
        hand.armature * acc.finger,
    )


def inner(force: Forces, acc: Acc, motion: Spatial) -> jax.Array:
    """Product of forces and accelerations over all bodies and joints, shape (1, world)."""

    def product(force: Forces, acc: Acc, motion: Spatial) -> jax.Array:
        links = sum_axis(dot(force.link, motion.link), 0)
        joints = sum_axis(sum_axis(force.finger * acc.finger, 0), 0)
        rest = dot(force.palm, motion.palm) + dot(force.object, motion.object)
        return sum_fingers(links + joints) + rest + dot(force.wrist, acc.wrist)

    return once(product, force, acc, motion)
