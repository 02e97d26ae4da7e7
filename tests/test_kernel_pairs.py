"""Contacts between fingers inside the rollout kernel, in float64: MuJoCo C and dense solves."""

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.constants import world_constants
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.model import hull, layout
from tests import small
from tests import test_hull_contact as oracle
from tests.test_finger_pairs import SETTINGS, curled, kinds


def one_step(scene, limits=None):
    """The compiled step of worlds from qpos and qvel under ctrl: qvel after it, and the trace."""
    engine = StructuredEngine(scene)
    program = Program.here(scene, limits or Limits(100, 40, 1e-24), np.float64)

    @jax.jit
    def run(fields, qpos, qvel, ctrl):
        start = engine.place(engine.reset(fields), qpos, qvel)
        trace, end = program.simulate(world_constants(scene, fields), start, ctrl[:, None])
        return engine.qvel(end), trace

    return run


def batched(worlds):
    """Fields, qpos, qvel and ctrl of several (model, data, fields)."""
    fields = jax.tree.map(lambda *x: np.concatenate(x), *(f for _, _, f in worlds))
    data = [d for _, d, _ in worlds]
    return fields, *(np.stack([getattr(d, n) for d in data]) for n in ("qpos", "qvel", "ctrl"))


# The quick tests have one state of spheres and one of hulls against the same oracles, among worlds
# with planted faults (test_planted_contacts).
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("friction", ["coulomb", "none", "full"])
def test_accelerations_equal_mujoco_on_curled_hands(friction):
    """Fingers touch one another and the object, sliding at up to a metre a second; or nothing."""
    with jax.enable_x64(True):
        scene = small.pinch("sphere", effects__friction=friction, **SETTINGS)
        worlds = [curled(scene, s, bend=0.75 + 0.05 * s, height=0.07) for s in range(6)]
        # Fingers apart: the accelerations of MuJoCo's model that has no such pairs.
        bare = small.pinch("sphere", effects__friction=friction, discretization__spheres_per_link=2)
        without, data, _ = curled(bare, 0, bend=0.1, height=0.12)
        worlds.append((without, data, curled(scene, 0, bend=0.1, height=0.12)[2]))
        for model, data, _ in worlds:
            mujoco.mj_forward(model, data)
        inputs = batched(worlds)
        run = one_step(scene)
        qvel, trace = run(*inputs)
        acc = (np.asarray(qvel) - inputs[2]) / scene.discretization.timestep
        for k, (model, data, _) in enumerate(worlds):
            between, held = kinds(model, data)
            assert between == 0 if model is without else between > 5 and held > 5
            error = np.linalg.norm(acc[k] - data.qacc) / np.linalg.norm(data.qacc)
            # As without these contacts: a difference of velocities, and MuJoCo's own rounding.
            assert error < 1e-8, (k, between, held, error)
        order = np.array([3, 1, 5, 0, 6, 2, 4])
        again, _ = run(*jax.tree.map(lambda x: np.asarray(x)[order], inputs))
        np.testing.assert_array_equal(again, qvel[order])
        assert not trace["overflow"].any() and trace["residual"].max() < 1e-20


class Dense(oracle.Dense):
    """A step's problem with the contacts of the hulls of different fingers, and of the palm."""

    def __init__(self, scene, model, data, hand):
        super().__init__(scene, model, data, hand)
        self.pairs = self.merged = self.on_palm = 0
        if scene.effects.finger_palm:
            for f in range(scene.num_fingers):
                self._add_palm(scene, model, data, hand, f)
        for f, other in np.ndindex(scene.num_fingers, scene.num_fingers):
            if f != other:
                self._add_rows(scene, model, data, hand, f, other)

    def _add_rows(self, scene, model, data, hand, f, other):
        """Resultants of the vertices of a finger's rows in the sections of another one's."""
        lay = layout(scene)
        for row, j in np.ndindex(lay.links + 1, lay.links):
            found = []
            for k in range(hull.slots(scene).along.shape[1]):
                point, jac_at, share = self._vertex(scene, model, data, hand, f, row, k)
                section = self._section(scene, data, hand, other, j, point)
                if section is not None:
                    gap, normal, at, weight = section
                    arm = -normal * gap / 2
                    behind = lay.stubs[other] + j, lay.stubs[other] + j + 1
                    jac = jac_at(arm) - self._jac(model, data, [point + arm], behind[:1], 1.0)
                    ends = [self._jac(model, data, [at + arm], (body,), 1.0) for body in behind]
                    found.append((share, -gap, normal, jac - weight * (ends[1] - ends[0])))
            if found:
                c = scene.contact
                rest = c.finger_finger_friction, c.finger_finger_friction_ratio, c.impedance
                self._add_resultant(scene, data, found, *rest)
                self.pairs += 1
                self.merged = max(self.merged, len(found))

    def _add_palm(self, scene, model, data, hand, f):
        """Resultants of the vertices of a finger's rows in the palm's disc, from a quarter on."""
        c, links, palm = scene.contact, scene.discretization.links, data.body("palm")
        frame, disc = palm.xmat.reshape(3, 3), scene.hand.palm
        stiffer = c.finger_palm_stiffness / c.normal_stiffness
        impedance = 1 - (1 - c.impedance) / stiffer
        for row in range(int(np.ceil(links / 4)), links + 1):
            found = []
            for k in range(hull.slots(scene).along.shape[1]):
                point, jac_at, share = self._vertex(scene, model, data, hand, f, row, k)
                x, y, z = (point - palm.xpos) @ frame
                depth, normal = min(
                    (disc.radius - np.hypot(x, y), (*np.array([x, y]) / np.hypot(x, y), 0)),
                    (z, (0, 0, -1)),
                    (disc.thickness - z, (0, 0, 1)),
                )
                if depth > 0:
                    normal = frame @ normal
                    arm = normal * depth / 2
                    jac = jac_at(arm) - self._jac(model, data, [point + arm], (palm.id,), 1.0)
                    found.append((2 * share, depth, normal, jac))
            if found:
                rest = c.finger_palm_friction, c.finger_finger_friction_ratio, impedance
                self._add_resultant(scene, data, found, *rest)
                self.on_palm += 1

    def _vertex(self, scene, model, data, hand, f, row, k):
        """Place of a vertex, its Jacobian as a function of an offset, and its share."""
        s, lay, width = hull.slots(scene), layout(scene), scene.hand.section.width
        segment, height = hand.length[f] / lay.links, hand.height[f]
        bodies = [lay.stubs[f], *lay.bodies[f]]
        pair = bodies[row], bodies[min(row + 1, lay.links)]
        v = np.array([s.along[row, k] * segment, s.across[row, k] * width, s.up[row, k] * height])
        step = 0 if row == lay.links else segment / 2 if row == 0 else segment
        w = s.weight[row, k]
        images = [
            data.xpos[b] + data.xmat[b].reshape(3, 3) @ p
            for b, p in zip(pair, (v + [step, 0, 0], v), strict=True)
        ]
        area = s.area[:, row, k] @ [segment * width, segment * height, width * height]
        point = (1 - w) * images[0] + w * images[1]

        def jac_at(arm):
            return self._jac(model, data, [x + arm for x in images], pair, w)

        return point, jac_at, 0.5 * area / width**2

    def _add_resultant(self, scene, data, found, friction, ratio, impedance):
        """One contact of all vertices of a row in another row, weighted by their forces."""
        share, depth = (np.array([v[k] for v in found]) for k in (0, 1))
        force = share * depth / (share @ depth)
        normal, jac = (np.tensordot(force, [v[k] for v in found], 1) for k in (2, 3))
        length = np.linalg.norm(normal)
        gap = -length * (share @ depth) / share.sum()
        self._add(
            scene, data, jac, normal / length, gap, friction, share.sum(), 2, ratio, impedance
        )

    @staticmethod
    def _section(scene, data, hand, f, row, point):
        """Gap and normal of a point in a finger's row, its material point, and its weight."""
        links, width = scene.discretization.links, scene.hand.section.width
        half, up = hand.length[f] / links / 2, hand.height[f] / 2
        body = layout(scene).stubs[f] + row
        frames = [data.xmat[b].reshape(3, 3) for b in (body, body + 1)]
        joint = data.xpos[body + 1]
        first, second = (frame.T @ (point - joint) for frame in frames)
        start, end, last = first[0] + half, half - second[0], row == links - 1
        if start < 0 or (end <= 0 and not last) or start + end <= 0:
            return None
        w = np.clip(start / (start + end), 0, 1)
        local, turned = (1 - w) * first + w * second, (1 - w) * frames[0] + w * frames[1]
        edge = 0.5 * min(width / 2, up)
        depth = np.array(
            [-end if last else -half, abs(local[1]) - width / 2, abs(local[2] - up) - up]
        )
        outside = np.maximum(depth + edge, 0)
        distance = np.linalg.norm(outside)
        gap = (distance if distance > 0 else (depth + edge).max()) - edge
        if gap >= 0:
            return None
        slope = outside if distance > 0 else np.eye(3)[depth.argmax()]
        normal = turned @ (slope * np.sign([1, local[1], local[2] - up]))
        return gap, normal / np.linalg.norm(normal), joint + frames[1] @ local, w


def test_hulls_equal_a_dense_solve():
    """Curled fingers whose hulls touch: resultants of vertices in sections, both ways."""
    with jax.enable_x64(True):
        settings = {"effects__finger_finger": True, "effects__surface": "hull"}
        density = {"discretization__hull_rings": 2, "discretization__hull_points": 8}
        scene = small.pinch("sphere", links=2, **settings, **density)
        hand, _ = small.hand_world(scene, length=0.1)
        bends = [(1, 0.8), (3, 1.0), (3, 1.2), (7, 0.8)]
        worlds = [curled(scene, seed, bend, height=0.07) for seed, bend in bends]
        inputs, step, order = batched(worlds), one_step(scene), np.array([2, 0, 3, 1])
        qvel, trace = step(*inputs)
        # A world passes through its contacts as often in other company, which converges elsewhere.
        mixed, _ = step(*jax.tree.map(lambda v: v[order], inputs))
        np.testing.assert_array_equal(mixed, np.asarray(qvel)[order])
        acc = (np.asarray(qvel) - inputs[2]) / scene.discretization.timestep
        most = merged = 0
        for k, (model, data, _) in enumerate(worlds):
            mujoco.mj_forward(model, data)
            dense = Dense(scene, model, data, hand)
            expected = dense.solve()
            error = np.linalg.norm(acc[k] - expected) / np.linalg.norm(expected)
            assert error < 1e-8, (k, dense.pairs, dense.num_hull, error)  # as against MuJoCo
            most, merged = max(most, dense.pairs), max(merged, dense.merged)
        assert most > 3 and merged > 2
