"""Faults planted in the kernel's own physics: the comparison with MuJoCo C notices each of them.

One kernel simulates all faults, each in a world of its own beside a world that is sound, see
`helpers/planted_faults.py`.  `test_steps.py` makes the same comparison of
sound kernels, with the same bounds; `test_planted_contacts.py` has the hull's stages and contacts
between fingers.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from tests.helpers import grasps, oracles
from tests.helpers.planted_faults import Fault, planted, simulate

STEPS = 8

# Stages of the kernel: functions that it evaluates lane by lane.
PALM = "palm_and_object"
LINK = "link_forces"
JAR = "as_candidates"
RESPONSE = "inertia_and_wrench"
RAY = "cost_along_line"
SLOPES = "slopes_along_line"
SOLVE = "Elimination.at_palm.<locals>.solve"
ELIMINATE = "eliminate_joint"
CENTRE = "add_weighted"


def link(**wrong: Callable):
    """A wrong `_link`: functions of some of its constants, joint states and forces, by name."""
    names = {"angle": "finger"}

    def stage(right, the_scene, parent, constants, joint):
        new = dict(constants), dict(joint)
        for name, change in wrong.items():
            name = names.get(name, name)
            group = next(g for g in new if name in g)
            group[name] = change(group[name])
        return right(the_scene, parent, *new)

    return {LINK: stage}


def without_gyroscopic(right, the_scene, parent, constants, joint):
    """Of the links' forces those that velocities cause."""
    origin, frame, vel, bias, motion = parent
    still = (origin, frame, 0 * vel, 0 * bias, motion)
    slow = joint | {"finger_vel": 0 * joint["finger_vel"]}
    carry, stored = right(the_scene, parent, constants, joint)
    return carry, stored | {"smooth": right(the_scene, still, constants, slow)[1]["smooth"]}


def cones(change: Callable):
    """Every stage that reads the friction cone reads another one."""

    def stage(right, place, cone, *rest):
        return right(place, change(cone), *rest)

    def candidates(right, margin, place, cone, *rest):
        return right(margin, place, change(cone), *rest)

    return dict.fromkeys((RESPONSE, RAY, SLOPES), stage) | {JAR: candidates}


def without_moment(right, *args):
    matrix, wrench = right(*args)
    return matrix, jnp.concatenate([0 * wrench[:3], wrench[3:]])


def without_reaction(right, node, *rest):
    """The fingers' contacts push the fingers, and the object does not feel it."""
    return right(node, *rest)._replace(r_object=node.r_object)


def at_palm(**change: Callable):
    """A wrong stage of palm, wrist and object: functions of the wrist's stiffness or gravity."""
    names = {"stiffness": "wrist_stiffness"}

    def stage(right, timestep, state, arm, constants):
        new = dict(constants)
        for name, f in change.items():
            new[names.get(name, name)] = f(constants[names.get(name, name)])
        return right(timestep, state, arm, new)

    return {PALM: stage}


def without_table(right, now, palm, node, pushes):
    kept = {k: jax.tree.map(jnp.zeros_like, v) for k, v in pushes.items()}
    return right(now, palm, node, kept)


def explicit(right, h, q, rate, acc):
    new, _, top = right(h, q, rate, acc)
    return new, q + h * rate, top


def spin_in_world_axes(right, h, state, columns, *acc):
    identity = [[jnp.full_like(columns[0, 0], i == k) for i in range(3)] for k in range(3)]
    return right(h, state, jnp.stack([jnp.stack(c) for c in identity]), *acc)


H = 0.01  # the scene's time step
FAULTS = {
    # wrong sign
    "springs push away": Fault(link(stiffness=jnp.negative)),
    "chambers bend outwards": Fault(link(pressure=jnp.negative)),
    "the wrist pushes away": Fault(at_palm(stiffness=jnp.negative)),
    "hinges of all joints in one order": Fault(link(order=jnp.abs)),
    # dropped terms
    "joints without damping": Fault(link(damping=jnp.zeros_like)),
    "links without weight": Fault(link(gravity=jnp.zeros_like)),
    "object and palm without weight": Fault(at_palm(gravity=jnp.zeros_like)),
    "no gyroscopic forces": Fault({LINK: without_gyroscopic}),
    "no implicit inertia": Fault(
        {ELIMINATE: lambda f, *a: f(*a[:2], jnp.zeros_like(a[2]), *a[3:])}
    ),
    "no moment of contact forces": Fault({RESPONSE: without_moment}),
    "no reaction on the object": Fault({"_add": without_reaction}),
    "no table under the object": Fault({SOLVE: without_table}),
    # stale state
    "angles of the step before": Fault(
        {
            LINK: lambda f, the_scene, parent, constants, joint: f(
                the_scene,
                parent,
                constants,
                joint | {"finger": joint["finger"] - H * joint["finger_vel"]},
            )
        }
    ),
    "contacts without velocity": Fault(
        {JAR: lambda f, margin, place, cone, motion, vel: f(margin, place, cone, motion, 0 * vel)}
    ),
    "contacts of the iteration before": Fault(
        {"tree_add_scaled": lambda f, alpha, value, change: value}
    ),
    "angles after explicit Euler": Fault({"joint_after_step": explicit}, "position"),
    "spin in the wrong frame": Fault({"body_after_step": spin_in_world_axes}),
    # wrong weight
    "links a tenth too heavy": Fault(link(mass=lambda m: 1.1 * m)),
    "a whole weight for half segments": Fault(
        {CENTRE: lambda f, middle, centre, share: f(middle, centre, jnp.ones_like(share))},
        "distance",
    ),
    # wrong cone
    "twice the friction": Fault(cones(lambda c: c.of_friction(2 * c.friction))),
    "friction as soft as normal contact": Fault(
        cones(lambda c: c._replace(tangential_mass=c.normal_mass, regularized_friction=c.friction))
    ),
    "a softer contact": Fault(cones(lambda c: c._replace(spring=0.9 * c.spring))),
}
BOUNDS = {"acceleration": 1e-8, "position": 1e-12, "distance": 1e-12}
"""As in test_steps.py."""


@pytest.fixture(scope="module")
def wrong():
    """Path of every fault's world, and of a sound one at the end, with what MuJoCo C needs."""
    with jax.enable_x64(True), planted(FAULTS):
        scene = grasps.pinch("box", links=2, effects__palm_object=False, effects__palm_table=False)
        fields, state, ctrl = touching(scene)
        outputs = jax.jit(partial(simulate, scene))(fields, state, ctrl, np.arange(len(ctrl)))
    path = oracles.Path(*(np.asarray(outputs[n]) for n in oracles.Path._fields))
    return scene, fields, np.asarray(ctrl), path


def touching(scene):
    """Fields, states and controls of a world for each fault and a sound one, all alike.

    Both fingers press on the box and on the table and slide at decimetres a second.
    """
    count = len(FAULTS) + 1
    random = np.random.default_rng(2)
    hand, trial = grasps.hand_world(scene, length=0.1)
    trial = trial._replace(mass=np.array(10.0))  # so that the fingers do not fling it away
    fields, ctrl = grasps.world_inputs(scene, hand, trial)
    qpos = np.array(fields.start)
    qpos[2] = 0.1
    qpos[3:6] = 0.1 * random.normal(size=3)
    dofs = model.layout(scene).dofs
    bend = np.zeros(dofs.shape)
    bend[..., 0] = 0.35
    qpos[-5] = qpos[-5] - 5e-4
    qpos[dofs] = bend + 0.05 * random.normal(size=bend.shape)
    qvel = 0.3 * random.normal(size=len(qpos) - 1)
    qvel[-4] = -0.2  # onto the table
    ctrl = np.repeat(np.asarray(ctrl[:1]), STEPS, 0)
    ctrl[:, :6] = qpos[:6] + 0.01
    ctrl[:, 6:] = 90e3
    many = grasps.repeat((fields, ctrl), count)
    return many[0], (np.repeat(qpos[None], count, 0), np.repeat(qvel[None], count, 0)), many[1]


def errors(wrong, world):
    """Errors of a world's steps by what is compared with MuJoCo C."""
    scene, fields, ctrl, path = wrong
    row = slice(world, world + 1)
    trajectory = oracles.Path(*(v[row] for v in path))
    batch = jax.tree.map(lambda v: v[row], fields)
    acceleration, far, touching = oracles.against_mujoco(scene, batch, ctrl[row], trajectory)
    compiled = world_model(scene, grasps.nth(fields, world))
    deviations = []
    for qpos, qvel, after in zip(
        trajectory.qpos[0], trajectory.qvel[0, 1:], trajectory.qpos[0, 1:], strict=False
    ):
        expected = qpos.copy()
        mujoco.mj_integratePos(compiled, expected, qvel, scene.discretization.timestep)
        deviations.append(np.abs(expected - after).max())
    largest = {
        "acceleration": acceleration.max(),
        "position": np.max(deviations),
        "distance": far.max(),
    }
    return largest, touching


def test_the_sound_world_equals_mujoco(wrong):
    """All checks pass without a fault, and everything touches that a fault could hide in."""
    largest, touching = errors(wrong, len(FAULTS))
    assert all(largest[name] < bound for name, bound in BOUNDS.items()), largest
    assert touching.max() >= 4 and touching.min() > 0


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_noticed(wrong, name):
    """By a hundred times its bound, or because nothing is left but NaN."""
    check = FAULTS[name].check
    largest, _ = errors(wrong, list(FAULTS).index(name))
    assert not largest[check] < 100 * BOUNDS[check], largest
