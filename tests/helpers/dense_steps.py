"""A step of hulls in contact, with all Jacobians written out and solved by SciPy."""

import mujoco
import numpy as np
import scipy.optimize

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.model import hull, layout
from tests.helpers import grasps

CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
BOX = [(CORNERS[k], CORNERS[(k + 1) % 4]) for k in range(4)]


def hull_scene(shape, links=3, **density):
    settings = {f"discretization__{k}": v for k, v in density.items()}
    return grasps.pinch(shape, links=links, effects__surface="hull", **settings)


def world(scene, **params):
    """Parameters, trial, model fields, oracle model and commands of one hand, in float64."""
    hand, trial = grasps.hand_world(scene, **params)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    fields, ctrl = grasps.world_inputs(scene, hand, trial)
    return hand, trial, fields, world_model(scene, fields), np.asarray(ctrl)


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
        self.num_hull, self.held = 0, []
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
        self,
        scene,
        data,
        jac,
        normal,
        gap,
        friction,
        share,
        bodies,
        ratio=None,
        impedance=None,
        grip=None,
        closing=0.0,
    ):
        c = scene.contact
        ratio = c.friction_ratio if ratio is None else ratio
        frame = np.linalg.svd(normal[None])[2]
        frame[0] = normal
        jac, d = frame @ jac, c.impedance if impedance is None else impedance
        r = (1 - d) / d * model.contact_invweight(scene) * bodies / share
        reference = -2 / (d * c.time_constant) * (jac @ data.qvel + [closing, 0, 0])
        reference[0] -= gap * d / (d * c.time_constant) ** 2
        if grip is not None:  # a share of the elastic normal force, which it is held by
            elastic = -gap * d / (d * c.time_constant) ** 2 / r
            reference[1:] -= elastic * r / ratio * (frame[1:] @ grip)
            self.held.append((len(self.rows), frame, elastic, grip))
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
        self.acceleration = start + back @ y
        return self.acceleration

    def force(self, row):
        """Force of a contact in its own frame at the solution."""
        jac, reference, r, friction = self.rows[row]
        root = np.sqrt([r[0], r[1], r[1]])
        z = (reference - jac @ self.acceleration) / root
        return project(z, friction * np.sqrt(r[1] / r[0]))[0] / root


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


class DensePairs(Dense):
    """A step's problem with the contacts of the hulls of different fingers, and of the palm."""

    def __init__(self, scene, model, data, hand, grip=None):
        """Grip: friction coefficient that the first of two fingers uses on the second one, (3,)."""
        super().__init__(scene, model, data, hand)
        self.grip = grip
        self.pairs = self.merged = self.on_palm = self.ahead = 0
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
                sign = 1.0 if f < other else -1.0
                if self.grip is None:
                    self._add_resultant(scene, data, found, *rest)
                else:
                    self._add_resultant(scene, data, found, *rest, sign * self.grip)
                    self.held[-1] += (sign,)
                self.pairs += 1
                self.merged = max(self.merged, len(found))

    def _add_palm(self, scene, model, data, hand, f):
        """Resultants of the vertices of a finger's rows in the palm's disc, from a quarter on."""
        c, links, palm = scene.contact, scene.discretization.links, data.body("palm")
        frame = palm.xmat.reshape(3, 3)
        stiffer = c.finger_palm_stiffness / c.normal_stiffness
        impedance = 1 - (1 - c.impedance) / stiffer
        for row in range(int(np.ceil(links / 4)), links + 1):
            vertices = []
            for k in range(hull.slots(scene).along.shape[1]):
                point, jac_at, share = self._vertex(scene, model, data, hand, f, row, k)
                gap, normal = from_disc(scene.hand.palm, (point - palm.xpos) @ frame)
                normal = frame @ normal
                arm = -normal * gap / 2
                jac = jac_at(arm) - self._jac(model, data, [point + arm], (palm.id,), 1.0)
                vertices.append((2 * share, -gap, normal, jac))
            rest = c.finger_palm_friction, c.finger_finger_friction_ratio, impedance
            if scene.effects.speculative_palm:
                self._add_ahead(scene, data, row, vertices, rest)
            elif found := [v for v in vertices if v[1] > 0]:
                self._add_resultant(scene, data, found, *rest)
                self.on_palm += 1

    def _add_ahead(self, scene, data, row, vertices, rest):
        """Contacts of a row's halves with the palm that act in the step that carries them in."""
        h, across = scene.discretization.timestep, hull.slots(scene).across[row]
        for side in (-1, 1):
            found, later = [], []
            for (share, depth, normal, jac), place in zip(vertices, across, strict=True):
                part = 0.5 if abs(place) < 1e-9 else float(np.sign(place) == side)
                if part:
                    later.append(max(depth, depth - h * normal @ jac @ data.qvel))
                    found.append((part * share, later[-1], normal, jac, depth))
            if max(later) <= 0:  # none will be inside: the nearest one may come in
                near = np.argmax(later)
                found = [(found[near][0], 1e-6, *found[near][2:])] if later[near] > -0.006 else []
            found = [v for v in found if v[1] > 0]
            if found:
                share, _, _, _, depth = (np.array([v[k] for v in found]) for k in range(5))
                share = share / share.sum()
                gaps = share @ np.minimum(-depth, 0), share @ np.maximum(-depth, 0) / h
                self._add_resultant(scene, data, found, *rest, gaps=gaps)
                self.on_palm += 1
                self.ahead += gaps[0] == 0

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

    def _add_resultant(self, scene, data, found, friction, ratio, impedance, grip=None, gaps=None):
        """One contact of all vertices of a row in another row, weighted by their forces.

        gaps: Of a contact ahead of touch the mean of the gaps below zero, and the speed that
        closes the mean of those above it in a step.
        """
        share, depth = (np.array([v[k] for v in found]) for k in (0, 1))
        force = share * depth / (share @ depth)
        normal, jac = (np.tensordot(force, [v[k] for v in found], 1) for k in (2, 3))
        length = np.linalg.norm(normal)
        gap, closing = gaps or (-(share @ depth) / share.sum(), 0.0)
        cone = friction, share.sum(), 2, ratio, impedance, grip
        self._add(scene, data, jac, normal / length, length * gap, *cone, closing=length * closing)

    def next_grip(self):
        """What the first finger uses in the solution: tangential over normal forces, or elastic."""
        above = below = 0.0
        for row, frame, elastic, grip, sign in self.held:
            force = self.force(row)
            weight = max(force[0], elastic)
            held = weight * frame[0] * (frame[0] @ grip) - frame[1:].T @ force[1:]
            above, below = above + sign * held, below + weight
        return above / below

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


def from_disc(palm, point):
    """Signed distance of a point from the palm's disc and its gradient, in the palm's frame."""
    beside = np.hypot(*point[:2])
    out = np.array([*point[:2] / beside, 0.0])
    up = np.array([0.0, 0.0, np.sign(point[2] - palm.thickness / 2)])
    excess = np.array(
        [beside - palm.radius, abs(point[2] - palm.thickness / 2) - palm.thickness / 2]
    )
    if (excess > 0).all():
        gap = np.hypot(*excess)
        return gap, (excess[0] * out + excess[1] * up) / gap
    return (excess[0], out) if excess[0] > excess[1] else (excess[1], up)


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
