"""Contacts between fingers inside the rollout kernel, in float64: MuJoCo C and dense solves."""

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import hull, layout
from tests import test_hull_contact as oracle
from tests.helpers import grasps
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
        scene = grasps.pinch("sphere", effects__friction=friction, **SETTINGS)
        worlds = [curled(scene, s, bend=0.75 + 0.05 * s, height=0.07) for s in range(6)]
        # Fingers apart: the accelerations of MuJoCo's model that has no such pairs.
        bare = grasps.pinch(
            "sphere", effects__friction=friction, discretization__spheres_per_link=2
        )
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
            for place, out, w, share in outline(scene, hand, f, row):
                point, jac_at, normal = self._point(scene, model, data, hand, f, row, place, w, out)
                section = self._section(scene, data, hand, other, j, point)
                if section is not None:
                    gap, at, weight = section
                    arm = -normal * gap / 2
                    behind = lay.stubs[other] + j, lay.stubs[other] + j + 1
                    jac = jac_at(arm) - self._jac(model, data, [point + arm], behind[:1], 1.0)
                    ends = [self._jac(model, data, [at + arm], (body,), 1.0) for body in behind]
                    jac = jac - weight * (ends[1] - ends[0])
                    found.append((0.5 * share, -gap, normal, jac))
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
        """Place of a vertex, its Jacobian as a function of an offset, and half its share."""
        s, width = hull.slots(scene), scene.hand.section.width
        segment, height = hand.length[f] / scene.discretization.links, hand.height[f]
        v = np.array([s.along[row, k] * segment, s.across[row, k] * width, s.up[row, k] * height])
        area = s.area[:, row, k] @ [segment * width, segment * height, width * height]
        found = self._point(scene, model, data, hand, f, row, v, s.weight[row, k], v)
        return *found[:2], 0.5 * area / width**2

    def _point(self, scene, model, data, hand, f, row, v, w, out):
        """Place of a point on two links, its Jacobian by an offset, and minus a direction."""
        lay, segment = layout(scene), hand.length[f] / scene.discretization.links
        bodies = [lay.stubs[f], *lay.bodies[f]]
        pair = bodies[row], bodies[min(row + 1, lay.links)]
        step = 0 if row == lay.links else segment / 2 if row == 0 else segment
        images = [
            data.xpos[b] + data.xmat[b].reshape(3, 3) @ p
            for b, p in zip(pair, (v + [step, 0, 0], v), strict=True)
        ]
        point = (1 - w) * images[0] + w * images[1]
        turned = [data.xmat[b].reshape(3, 3) @ out for b in pair]

        def jac_at(arm):
            return self._jac(model, data, [x + arm for x in images], pair, w)

        return point, jac_at, -((1 - w) * turned[0] + w * turned[1])

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
        """Gap of a point in a finger's row, its material point, and its weight."""
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
        local = (1 - w) * first + w * second
        cap = max(second[0], 0) / half if last else 0.0
        units, sides = (
            np.array([cap, *((local[1:] - [0, up]) / [width / 2, up])]),
            [half, width / 2, up],
        )
        phi = (units**4).sum() ** 0.25
        slope = np.linalg.norm(units**3 / phi**3 / sides)
        if phi >= 1:
            return None
        return (phi - 1) / slope, joint + frames[1] @ local, w


def outline(scene, hand, f, row):
    """Points of a finger's row on its outline: place, outward normal, weight, share of the surface.

    On |x/c|^4 + |y/a|^4 + |z/b|^4 = 1, with x from the last joint to the tip only.
    """
    d, width, height = scene.discretization, scene.hand.section.width, hand.height[f]
    links, rings = d.links, d.hull_rings
    segment, sides = hand.length[f] / links, np.array([width, height]) / 2
    around = np.concatenate([np.linspace(a, b, d.hull_points // 2, endpoint=False) for a, b in BOX])
    around = around / (around**4).sum(1, keepdims=True) ** 0.25
    ends = np.roll(around, -1, 0) * sides - around * sides
    arc = np.linalg.norm(ends, axis=1)
    arc = (arc + np.roll(arc, 1)) / 2
    x, y = (around * sides).T
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    rim, tip = 2**-0.25, row == links
    along = np.linspace(-1, 1, rings + 1)
    scale = rim * (1 - np.arange(rings + 1) / rings)
    bounds = np.append(np.append(rim, (scale[1:] + scale[:-1]) / 2), 0.0) ** 2
    if row == links - 1:
        along[-1] = rim
        along = np.minimum(along, rim)
    if tip:
        along = np.append(rim, (1 - scale[1:] ** 4) ** 0.25)
    for r in range(1, rings + 1):
        at = along[r]
        cap = at if row >= links - 1 and at > 0 else 0.0
        size = (1 - cap**4) ** 0.25
        ahead = along[r + 1] if r < rings else 2 / rings + 1 if row < links - 1 else at
        span = 0.0 if tip else (ahead - along[r - 1]) / 2 * segment / 2
        band = bounds[r] - bounds[r + 1] if tip else 0.0
        if row == links - 1 and r == rings:
            band = bounds[0] - bounds[1]
        for unit, part in zip(around, arc, strict=True):
            place = np.array([at * segment / 2, *(size * unit * sides + [0, sides[1]])])
            out = np.array([cap**3 / (segment / 2), *((size * unit) ** 3 / sides)])
            share = (size * part * span + band * area / len(around)) / width**2
            yield place, out / np.linalg.norm(out), 0.0 if tip else (at + 1) / 2, share


CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
BOX = [(CORNERS[k], CORNERS[(k + 1) % 4]) for k in range(4)]


def test_hulls_equal_a_dense_solve():
    """Curled fingers whose hulls touch: resultants of vertices in sections, both ways."""
    with jax.enable_x64(True):
        settings = {"effects__finger_finger": True, "effects__surface": "hull"}
        density = {"discretization__hull_rings": 2, "discretization__hull_points": 8}
        scene = grasps.pinch("sphere", links=2, **settings, **density)
        hand, _ = grasps.hand_world(scene, length=0.1)
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
