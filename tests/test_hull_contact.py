"""Contacts of the skinned hull: against MuJoCo C where it is rigid, against a dense solve elsewhere."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, hull, model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.hand import hand_lanes
from tests import small
from tests.test_structured import lanes_state

TINY = 1e-12  # [m] radius of MuJoCo's stand-ins for points


def hull_scene(shape, links=3, **density):
    settings = {f"discretization__{k}": v for k, v in density.items()}
    return small.pinch(shape, links=links, effects__surface="hull", **settings)


def world(scene, **params):
    """Parameters, trial, model fields, oracle model and commands of one hand, in float64."""
    hand, trial = small.hand_world(scene, **params)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    params = jax.tree.map(jnp.asarray, hand)
    fields = model.model_fields(scene, params, trial)
    ctrl = np.asarray(control.commands(scene, params, trial))
    return hand, trial, fields, world_model(scene, fields), ctrl


class Driven:
    """The structured engine stepping one world to convergence."""

    def __init__(self, scene, fields):
        self.engine = StructuredEngine(scene, iterations=100, evaluations=16, tolerance=1e-24)
        self.scene = scene
        self.fields = jax.tree.map(lambda x: jnp.asarray(x)[None], fields)
        self.hand, self.step = hand_lanes(scene, self.fields), jax.jit(self.engine.step)

    def state(self, qpos, qvel):
        return lanes_state(self.engine, self.scene, self.fields, qpos, qvel)

    def advance(self, state, ctrl):
        return self.step(self.hand, state, jnp.asarray(ctrl)[:, None])[0]

    def coordinates(self, state):
        return np.asarray(self.engine.qpos(state))[0], np.asarray(self.engine.qvel(state))[0]


def with_points(scene, hand, trial):
    """MuJoCo's model with a tiny sphere at each vertex of a hull whose rings are rigid.

    A vertex's compliance is the scene's times its share of a width squared: with MuJoCo's
    R = (1 - d)/d invweight that is another impedance d, and a direct reference (stiffness, damping).
    """
    spec = model.build_spec(scene, hand, trial)
    slots, c, width = hull.slots(scene), scene.contact, scene.hand.section.width
    for f in range(scene.num_fingers):
        segment, height = float(hand.length[f]) / scene.discretization.links, float(hand.height[f])
        area = np.array([segment * width, segment * height, width * height]) @ slots.area.reshape(3, -1)
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


@pytest.mark.parametrize("shape", small.SHAPES)
def test_rigid_rings_equal_mujoco(shape):
    """One ring a link has weights of zero and one: points on rigid links, as MuJoCo knows them."""
    with jax.enable_x64(True):
        scene = hull_scene(shape, hull_rings=1, hull_points=8)
        hand, trial, fields, _, ctrl = world(scene)
        oracle = with_points(scene, hand, trial)
        driven, data = Driven(scene, fields), mujoco.MjData(oracle)
        data.qpos[:] = np.asarray(fields.start)
        touched = set()
        for k in range(420):
            data.ctrl[:] = ctrl[k]
            if k % 35 == 20:
                qpos, qvel = data.qpos.copy(), data.qvel.copy()
                mujoco.mj_forward(oracle, data)
                new = driven.advance(driven.state(qpos, qvel), ctrl[k])
                acc = (driven.coordinates(new)[1] - qvel) / scene.discretization.timestep
                error = np.linalg.norm(acc - data.qacc) / max(np.linalg.norm(data.qacc), 100.0)
                # As with spheres: a difference of velocities loses two of 16 digits, and
                # MuJoCo's own Newton stops at rounding of its cost.
                assert error < 1e-8, (k, data.ncon, error)
                names = {mujoco.mj_id2name(oracle, 5, int(g)) for g in data.contact.geom.ravel()}
                touched |= {n for n in names if n.startswith("point")}
            mujoco.mj_step(oracle, data)
        assert len(touched) > 4
