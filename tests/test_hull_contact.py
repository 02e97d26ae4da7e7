"""Contacts of the skinned hull: MuJoCo C where it is rigid; a dense solve for other tests."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.optimize

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.model import hull
from tests.helpers import grasps, oracles

TINY = 1e-12  # [m] radius of MuJoCo's stand-ins for points


def hull_scene(shape, links=3, **density):
    settings = {f"discretization__{k}": v for k, v in density.items()}
    return grasps.pinch(shape, links=links, effects__surface="hull", **settings)


def world(scene, **params):
    """Parameters, trial, model fields, oracle model and commands of one hand, in float64."""
    hand, trial = grasps.hand_world(scene, **params)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    fields, ctrl = grasps.world_inputs(scene, hand, trial)
    return hand, trial, fields, world_model(scene, fields), np.asarray(ctrl)


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


def distance(scene, data, points):
    """Distance to the object and its gradient, world frame, by closed forms."""
    shape, centre = scene.objects.object[0], data.body("object").xpos
    half, turn = np.array(shape.half_sizes), data.body("object").xmat.reshape(3, 3)
    local = (points - centre) @ turn
    if shape.type == "sphere":
        length = np.linalg.norm(local, axis=1)
        return length - half[0], (local / length[:, None]) @ turn.T
    if shape.type == "cylinder":
        beside = np.hypot(local[:, 0], local[:, 1])
        excess = np.stack([beside - half[0], np.abs(local[:, 2]) - half[1]], 1)
        out = np.maximum(excess, 0)
        outside = np.linalg.norm(out, axis=1)
        face = np.eye(2)[excess.argmax(1)]
        slope = np.where(outside[:, None] > 0, out / np.maximum(outside, 1e-300)[:, None], face)
        axes = [local[:, 0] / beside, local[:, 1] / beside, np.sign(local[:, 2])]
        gradient = np.stack(
            [slope[:, 0] * axes[0], slope[:, 0] * axes[1], slope[:, 1] * axes[2]], 1
        )
        return np.where(outside > 0, outside, excess.max(1)), gradient @ turn.T
    excess = np.abs(local) - half
    out = np.maximum(excess, 0)
    outside = np.linalg.norm(out, axis=1)
    face = np.eye(3)[excess.argmax(1)]
    gradient = np.where(outside[:, None] > 0, out / np.maximum(outside, 1e-300)[:, None], face)
    return np.where(outside > 0, outside, excess.max(1)), (gradient * np.sign(local)) @ turn.T


class Dense:
    """A step's problem with all Jacobians written out, from MuJoCo's mass matrix and mj_jac."""

    def __init__(self, scene, oracle, data, hand):
        self.mass = np.zeros((oracle.nv, oracle.nv))
        mujoco.mj_fullM(oracle, data, self.mass)
        self.smooth = data.qfrc_smooth.copy()
        self.rows = []  # (Jacobian (3, nv), reference (3,), R of normal and tangent, friction)
        for c in data.contact:
            if c.efc_address < 0:  # apart
                continue
            rows = slice(c.efc_address, c.efc_address + 3)
            jac = data.efc_J.reshape(-1, oracle.nv)[rows]
            self.rows.append((jac, data.efc_aref[rows], 1 / data.efc_D[rows][:2], c.friction[0]))
        self.num_hull = 0
        for f in range(scene.num_fingers):
            self._add_finger(scene, oracle, data, hand, f)

    def _add_finger(self, scene, oracle, data, hand, f):
        s, lay, width = hull.slots(scene), model.layout(scene), scene.hand.section.width
        segment, height = hand.length[f] / lay.links, hand.height[f]
        bodies = [lay.stubs[f], *lay.bodies[f]]
        for row, k in np.ndindex(s.along.shape):
            joint = bodies[min(row + 1, lay.links)]
            before = bodies[row]
            v = np.array(
                [s.along[row, k] * segment, s.across[row, k] * width, s.up[row, k] * height]
            )
            # The joint is the origin of the link's frame and half or one segment along its parent.
            step = 0 if row == lay.links else segment / 2 if row == 0 else segment
            w = s.weight[row, k]
            images = [
                data.xpos[b] + data.xmat[b].reshape(3, 3) @ p
                for b, p in ((before, v + [step, 0, 0]), (joint, v))
            ]
            point = (1 - w) * images[0] + w * images[1]
            area = s.area[:, row, k] @ [segment * width, segment * height, width * height]
            share = area / width**2
            gap, normal = distance(scene, data, point[None])
            to_object = gap[0], normal[0], scene.objects.object[0].friction, lay.object
            to_table = point[2], np.array([0, 0, 1.0]), scene.contact.finger_table_friction, 0
            for gap, normal, friction, other in (to_object, to_table):
                if gap < 0:
                    arm = -normal * gap / 2
                    jac = self._jac(oracle, data, [x + arm for x in images], (before, joint), w)
                    jac = jac - self._jac(oracle, data, [point + arm], (other,), 1.0)
                    self._add(scene, data, jac, normal, gap, friction, share, 2 if other else 1)

    @staticmethod
    def _jac(oracle, data, points, bodies, weight):
        total = 0.0
        for point, body, w in zip(
            points, bodies, (1 - weight, weight)[-len(points) :], strict=True
        ):
            jac = np.zeros((3, oracle.nv))
            mujoco.mj_jac(oracle, data, jac, None, point, body)
            total = total + w * jac
        return total

    def _add(
        self, scene, data, jac, normal, gap, friction, share, bodies, ratio=None, impedance=None
    ):
        c = scene.contact
        ratio = c.friction_ratio if ratio is None else ratio
        frame = np.linalg.svd(normal[None])[2]
        frame[0] = normal
        jac, d = frame @ jac, c.impedance if impedance is None else impedance
        r = (1 - d) / d * model.contact_invweight(scene) * bodies / share
        reference = -2 / (d * c.time_constant) * (jac @ data.qvel)
        reference[0] -= gap * d / (d * c.time_constant) ** 2
        self.rows.append((jac, reference, np.array([r, r / ratio]), friction))
        self.num_hull += 1

    def solve(self):
        """Accelerations where the gradient vanishes, by SciPy."""
        start = np.linalg.solve(self.mass, self.smooth)
        factor = np.linalg.cholesky(self.mass)  # in these coordinates the smooth part is round
        back = np.linalg.inv(factor).T

        def parts(y):
            value, grad, hess = 0.5 * y @ y, y.copy(), np.eye(len(y))
            for jac, reference, r, friction in self.rows:
                whitened = jac @ back / np.sqrt([r[0], r[1], r[1]])[:, None]
                jar = (jac @ start - reference) / np.sqrt([r[0], r[1], r[1]]) + whitened @ y
                # f maximises -1/2 f'Rf - f'jar in Coulomb's cone: a projection, R^(1/2) f.
                force, slope = project(-jar, friction * np.sqrt(r[1] / r[0]))
                value += 0.5 * force @ force
                grad -= whitened.T @ force
                hess += whitened.T @ slope @ whitened
            return value, grad, hess

        result = scipy.optimize.minimize(
            lambda y: parts(y)[0],
            np.zeros(len(start)),
            jac=lambda y: parts(y)[1],
            hess=lambda y: parts(y)[2],
            method="trust-exact",
            options={"gtol": 1e-9, "maxiter": 500},
        )
        # The trust region compares rounded values and stops early: full steps from there.
        y = result.x
        for _ in range(5):
            _, grad, hess = parts(y)
            y = y - np.linalg.solve(hess, grad)
        assert np.linalg.norm(parts(y)[1]) < 1e-9 * (1 + np.linalg.norm(y))
        return start + back @ y


def project(z, slope):
    """Euclidean projection onto |z_t| <= slope z_n, and its derivative."""
    n, t = z[0], z[1:]
    length = np.linalg.norm(t)
    if length <= slope * n:
        return z, np.eye(3)
    if n <= -slope * length:
        return 0 * z, np.zeros((3, 3))
    e = t / length
    ray = np.concatenate([[1.0], slope * e]) / np.sqrt(1 + slope**2)
    size = ray @ z
    across = np.zeros((3, 3))
    across[1:, 1:] = (np.eye(2) - np.outer(e, e)) * ray[0] * slope * size / length
    return ray * size, np.outer(ray, ray) + across
