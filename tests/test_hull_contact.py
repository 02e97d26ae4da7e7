"""Contacts of the skinned hull: MuJoCo C where it is rigid; a dense solve for other tests."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.model import hull
from tests.helpers import oracles
from tests.helpers.dense_steps import hull_scene, world

TINY = 1e-12  # [m] radius of MuJoCo's stand-ins for points


def with_points(scene, hand, trial):
    """MuJoCo's model with a tiny sphere at each vertex of a hull whose rings are rigid.

    A vertex's compliance is the scene's times its share of a width squared: with MuJoCo's
    R = (1 - d)/d invweight that is another impedance d, and a reference given directly as
    (stiffness, damping).
    """
    spec = model.build_spec(scene, hand, trial)
    slots, c, width = hull.slots(scene), scene.contact, scene.hand.section.width
    for f in range(scene.num_fingers):
        segment, height = float(hand.length[f]) / scene.discretization.links, float(hand.height[f])
        area = np.array([segment * width, segment * height, width * height]) @ slots.area.reshape(
            3, -1
        )
        share = area.reshape(slots.along.shape) / width**2
        for row, k in np.ndindex(slots.along.shape):
            link = min(row + 1, scene.discretization.links)
            name = f"point_{f}_{row}_{k}"
            body = spec.body(f"finger_{f}_link_{link}")
            place = [
                slots.along[row, k] * segment,
                slots.across[row, k] * width,
                slots.up[row, k] * height,
            ]
            body.add_geom(name=name, size=[TINY, 0, 0], pos=place, contype=0, conaffinity=0)
            d = c.impedance
            own = 1 / (1 + (1 - d) / d / share[row, k])
            # MuJoCo: b = damping/own, k = stiffness/own^2, and the penetration counts times own.
            damping = 2 / (d * c.time_constant) * own
            stiffness = 1 / (d * c.time_constant) ** 2 * d * own
            for other, friction in (
                ("object_0", scene.objects.object[0].friction),
                ("table", c.finger_table_friction),
            ):
                pair = spec.add_pair(geomname1=name, geomname2=other, condim=3)
                pair.friction = [friction, friction, 0.005, 0.0001, 0.0001]
                pair.solref = [-stiffness, -damping]
                pair.solimp = [own, own, 0.001, 0.5, 2.0]
    compiled = spec.compile()
    compiled.body_invweight0[1:] = model.contact_invweight(scene)
    compiled.opt.tolerance, compiled.opt.iterations, compiled.opt.ls_iterations = 0.0, 200, 50
    return compiled


SLOW = pytest.mark.slow  # half a minute of compiling each


@pytest.mark.parametrize("shape", ["cylinder", pytest.param("box", marks=SLOW)])
def test_rigid_rings_equal_mujoco(shape):
    """One ring a link has weights of zero and one: points on rigid links, as MuJoCo knows them."""
    with jax.enable_x64(True):
        scene = hull_scene(shape, hull_rings=1, hull_points=8)
        hand, trial, fields, _, ctrl = world(scene)
        oracle = with_points(scene, hand, trial)
        fields = jax.tree.map(lambda x: jnp.asarray(x)[None], fields)
        engine = StructuredEngine(scene, iterations=100, evaluations=40, tolerance=1e-24)
        found = oracles.path(engine, fields, ctrl[None, :420])
    data, touched, h = mujoco.MjData(oracle), set(), scene.discretization.timestep
    for k in range(1, 419):
        qvel, after = found.qvel[0, k : k + 2]
        data.qpos[:], data.qvel[:], data.ctrl[:] = found.qpos[0, k], qvel, ctrl[k]
        mujoco.mj_forward(oracle, data)
        error = np.linalg.norm((after - qvel) / h - data.qacc)
        # As with spheres: a difference of velocities loses two of 16 digits, and MuJoCo's own
        # Newton stops at rounding of its cost.
        assert error < 1e-8 * max(np.linalg.norm(data.qacc), oracles.FLOOR), (k, data.ncon, error)
        names = {mujoco.mj_id2name(oracle, 5, int(g)) for g in data.contact.geom.ravel()}
        touched |= {n for n in names if n.startswith("point")}
    assert len(touched) > 4
