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
from codesign_jax.engines import depths
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.kernel.contact_list import margin
from codesign_jax.engines.structured.lanes import dot, once, scan_links
from codesign_jax.engines.structured.laws import surroundings
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.contact import (
    Cone,
    Contacts,
    candidates,
    constraint_update,
)
from codesign_jax.engines.structured.laws.inertia import LARGEST_FREE_TURN, LARGEST_TURN
from codesign_jax.engines.structured.laws.kinematics import (
    Acc,
    Kinematics,
    Spatial,
    kinematics,
    next_acceleration,
    palm_acceleration,
    relative,
)
from codesign_jax.engines.structured.world_model import world_constants
from tests.helpers import grasps

FLOOR = 100.0
"""Smallest scale of relative errors of accelerations, ten g: at rest they are rounding."""


def propagate(kin: Kinematics, acc: Acc) -> Spatial:
    """Spatial accelerations J a of all bodies, without velocity terms."""
    palm = once(palm_acceleration, acc.wrist, kin.wrist_axes)

    def step(parent: jax.Array, link: tuple):
        link_acc = once(next_acceleration, parent, *link)
        return link_acc, link_acc

    first = palm + jnp.zeros_like(kin.vel[:, 0])
    _, links = scan_links(step, first, (kin.axes, acc.finger))
    return Spatial(palm, jnp.moveaxis(links, 0, 1), acc.object)


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

    outputs = run(fields, jnp.asarray(ctrl))
    return Path(*(np.asarray(outputs[name]) for name in Path._fields))


def exact(scene, fields):
    """MuJoCo C's model of a world, solved to rounding."""
    compiled = world_model(scene, fields)
    compiled.opt.tolerance = 0.0
    compiled.opt.iterations = 200
    compiled.opt.ls_iterations = 50
    return compiled


def at_states(scene, fields, ctrl, trajectory, stride=1):
    """MuJoCo C at the states of a path: yields world, number of the step, model and data.

    It converges at each of them. The start is left out: there the object is so exactly on the
    table that rounding decides whether it touches.
    """
    for world in range(len(ctrl)):
        world_fields = grasps.nth(fields, world)
        compiled = exact(scene, world_fields)
        data = mujoco.MjData(compiled)
        for k in range(1, ctrl.shape[1] - 1, stride):
            data.qpos[:] = trajectory.qpos[world, k]
            data.qvel[:] = trajectory.qvel[world, k]
            data.ctrl[:] = ctrl[world, k]
            soften(scene, world_fields, compiled, data)
            mujoco.mj_forward(compiled, data)
            yield world, k, compiled, data


def turns_fast(scene, data):
    """Whether a body turns so fast that its velocity products are not MuJoCo's: `laws.inertia`."""
    lay = model.layout(scene)
    turns = scene.discretization.timestep * np.linalg.norm(data.cvel[:, :3], axis=1)
    return turns[lay.bodies].max() > LARGEST_TURN or turns[lay.object] > LARGEST_FREE_TURN


def against_mujoco(
    scene, fields, ctrl, trajectory, stride=1
) -> tuple[np.ma.MaskedArray, np.ndarray, np.ndarray]:
    """Errors of a path's steps against MuJoCo C, see `at_states`.

    Relative ones of accelerations, masked where `turns_fast`, of distances [m], and numbers of
    contacts, (world, state).
    """
    h = scene.discretization.timestep
    lay = model.layout(scene)
    errors = []
    fast = []
    far = []
    touching = []
    for world, k, _, data in at_states(scene, fields, ctrl, trajectory, stride):
        qvel, after = trajectory.qvel[world, k : k + 2]
        fast.append(turns_fast(scene, data))
        errors.append(relative_change((after - qvel) / h, data.qacc))
        away = data.xipos[lay.object] - lay.centre_weights @ data.xipos
        far.append(abs(np.linalg.norm(away) - trajectory.distance[world, k]))
        touching.append(data.ncon)
    shape = len(ctrl), -1
    compared = np.ma.MaskedArray(errors, fast).reshape(shape)
    return compared, np.reshape(far, shape), np.reshape(touching, shape)


def share(errors):
    """Share of masked errors that are compared."""
    return errors.count() / errors.size


def relative_change(acceleration, exactly):
    """How far accelerations are from exact ones, relative to these or to `FLOOR`."""
    return np.linalg.norm(acceleration - exactly) / max(np.linalg.norm(exactly), FLOOR)


def soften(scene, fields, compiled, data):
    """What the engine `mujoco` applies before a step."""
    if scene.hand.section.law == "elements":
        dofs = model.layout(scene).dofs
        fields = jax.tree.map(np.asarray, fields)
        springs = model.section_springs(scene, fields, data.qpos[dofs], data.ctrl[6:])
        arrays = data.qfrc_applied, compiled.dof_damping, compiled.dof_armature
        for array, values in zip(arrays, springs, strict=True):
            array[dofs] = values
    elif scene.effects.neo_hookean:
        bend = model.layout(scene).dofs[..., 0]
        data.qfrc_applied[bend] = model.softening_moments(scene, fields, data.qpos[bend])


def touching(scene, hand, kin: Kinematics, position, velocity: Spatial):
    """Contacts with object, table and fixtures over whole arrays, by pair of bodies."""
    by_pair = {}
    for name, place in depths.places(scene, hand, kin, position).items():
        cone = getattr(hand.cones, which_cone(name))
        fingers = name.startswith("finger")
        if friction_by_contact(scene, name):
            fields = 1 if name.endswith("_object") else len(surroundings.fields(scene))
            count = place.gap.shape[int(fingers)] // fields
            friction = hand.friction[np.array(surroundings.touched(scene, name, count))]
            cone = Cone.of_friction(cone, friction if fingers else friction[:, 0])
        contacts = Contacts(*place[:3], cone.of_share(place.share))
        approach = -dot(place.normal, contacts.relative(relative(name, velocity)))
        share = candidates(place.share, place.gap, approach, cone, margin(scene))
        by_pair[name] = contacts._replace(cone=cone.of_share(share))
    return by_pair


def to_mujoco(data, end):
    """Matrix from our velocities to MuJoCo's, whose object, from `end` on, moves otherwise.

    By (linear, angular in its own axes) instead of (angular, linear).
    """
    turn = np.eye(len(data.qvel))
    turn[end:, end:] = 0.0
    turn[end : end + 3, end + 3 :] = np.eye(3)
    turn[end + 3 :, end : end + 3] = data.body("object").xmat.reshape(3, 3).T
    return turn


def unbalanced(scene, fields, ctrl, trajectory, stride):
    """Forces that a path's accelerations leave unbalanced: the gradient of a step's objective.

    Mass matrix and smooth forces are MuJoCo C's.  Forces of contacts are found over whole arrays,
    by the functions of geometry and friction cone that the kernel calls.  The largest on wrist,
    which is compliant, joints and object, each over the largest of all states if nothing were
    accelerated, shape (3, state); masked where `turns_fast`.
    """
    end = 6 + model.layout(scene).dofs.size
    count = -(-ctrl.shape[1] // stride)
    states = [v[:, ::stride] for v in (trajectory.qpos, trajectory.qvel, trajectory.acc, ctrl)]
    qpos, qvel, acc, u = (np.asarray(v).reshape(-1, v.shape[-1]) for v in states)
    many = jax.tree.map(lambda v: np.repeat(np.asarray(v), count, 0), fields)

    @jax.jit
    def pushes(many, qpos, qvel, acc):
        state = coordinates.make(scene, qpos, qvel, acc)
        hand = world_constants(scene, many)
        kin = kinematics(hand, model.layout(scene).axes, state)
        velocity = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
        contacts = touching(scene, hand, kin, state.position, velocity)

        def power(virtual: Acc, acc: Acc):
            motion = propagate(kin, acc)
            along = propagate(kin, virtual)
            each = [0.0 * along.object.sum()]
            for name, c in contacts.items():
                speed = c.relative(relative(name, velocity))
                jar = c.relative(relative(name, motion)) - c.reference(speed)
                force = constraint_update(c, jar).force
                each.append(dot(force, c.relative(relative(name, along))).sum())
            return sum(each)

        none = jax.tree.map(jnp.zeros_like, state.acc)
        # Power is linear in the virtual accelerations: its slope is the force itself.
        return [coordinates.flat_acc(jax.grad(power)(none, a)) for a in (state.acc, none)]

    compiled = pushes.lower(many, qpos, qvel, acc).compile({"xla_backend_optimization_level": 0})
    pushed, at_rest = (np.asarray(v) for v in compiled(many, qpos, qvel, acc))
    left = np.empty((2, *pushed.shape))
    fast = np.zeros(len(qpos), bool)
    for k in range(len(qpos)):
        if k % count == 0:
            world_fields = grasps.nth(fields, k // count)
            oracle = world_model(scene, world_fields)
            data = mujoco.MjData(oracle)
            mass = np.zeros((oracle.nv, oracle.nv))
        data.qpos[:] = qpos[k]
        data.qvel[:] = qvel[k]
        data.ctrl[:] = u[k]
        soften(scene, world_fields, oracle, data)
        mujoco.mj_forward(oracle, data)
        mujoco.mj_fullM(oracle, data, mass)
        turn = to_mujoco(data, end)
        smooth = turn.T @ data.qfrc_smooth
        left[0, k] = turn.T @ mass @ turn @ acc[k] - smooth - pushed[k]
        left[1, k] = -smooth - at_rest[k]
        fast[k] = turns_fast(scene, data)
    parts = slice(0, 6), slice(6, end), slice(end, None)
    worst = np.array([[np.abs(v[:, part]).max(1) for part in parts] for v in left])
    # At rest nothing is accelerated, and what is left is rounding of forces that cancel.
    left_over = worst[0] / worst[1].max(1, keepdims=True)
    return np.ma.MaskedArray(left_over, np.broadcast_to(fast, left_over.shape))
