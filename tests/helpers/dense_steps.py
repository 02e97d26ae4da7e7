"""A step of rings in contact, with all Jacobians written out and solved by SciPy."""

from typing import NamedTuple

import mujoco
import numpy as np
import scipy.optimize

from codesign_jax import model
from codesign_jax.model import layout
from codesign_jax.model.held import keeps

FLOOR = 1e-6
"""Under the roots of the law, which have no slope at zero; see `laws.rings`."""


def distance(scene, data, points):
    """Distance to the object, a sphere, and its gradient, world frame."""
    away = points - data.body("object").xpos
    length = np.linalg.norm(away, axis=1)
    return length - scene.objects.object[0].half_sizes[0], away / length[:, None]


class Dense:
    """A step's problem with all Jacobians written out, from MuJoCo's mass matrix and mj_jac."""

    def __init__(self, scene, oracle, data, hand, holds=None):
        """Holds: friction coefficients that contacts with object and table use, by their names.

        They are along the object's axes where it is touched, and along the world's on the table.
        """
        self.holds = holds or {}
        self.turn = data.body("object").xmat.reshape(3, 3)
        self.mass = np.zeros((oracle.nv, oracle.nv))
        mujoco.mj_fullM(oracle, data, self.mass)
        self.smooth = data.qfrc_smooth.copy()
        self.scene = scene
        self.oracle = oracle
        self.data = data
        self.fingers = [Rings(scene, data, hand, f) for f in range(scene.num_fingers)]
        self.rows = []  # (Jacobian (3, nv), reference (3,), R of normal and tangent, friction)
        self.num_hull = 0
        self.held = []
        self._on_table()
        for f, finger in enumerate(self.fingers):
            for number, ring in enumerate(finger.rings):
                self._on_fields(ring, (f, number))

    def _on_table(self):
        """The sphere's lowest point on the table."""
        body = self.data.body("object")
        up = np.array([0, 0, 1.0])
        gap = body.xpos[2] - self.scene.objects.object[0].half_sizes[0]
        ends = model.layout(self.scene).object, 0
        point = body.xpos * [1, 1, 0] + gap / 2 * up
        friction = self.scene.objects.table.friction
        self._add(point, up, gap, 1.0, ends, friction, 1, **self._held("lowest", False))

    def _held(self, name, on_object):
        """What a contact of object or table holds, and how hard its friction is."""
        if not keeps(self.scene):
            return {}
        grip = self.holds.get(name, np.zeros(3))
        grip = self.turn @ grip if on_object else grip
        return {"ratio": self.scene.contact.held_friction_ratio, "grip": grip, "name": name}

    def _on_fields(self, ring, number):
        scene = self.scene
        lay = model.layout(self.scene)

        def from_object(point):
            gap, normal = distance(scene, self.data, point[None])
            return gap[0], normal[0]

        def from_table(point):
            return point[2], np.array([0, 0, 1.0])

        on = (from_object, scene.objects.object[0].friction, lay.object, 2)
        for field, friction, other, bodies in (
            on,
            (from_table, scene.contact.finger_table_friction, 0, 1),
        ):
            place = on_field(ring, field)
            on_object = field is from_object
            grips_of_ring = self._held((*number, on_object), on_object)
            self._add(*place, (ring.body, other), friction, bodies, **grips_of_ring)

    def jac(self, point, body):
        """Jacobian of a body's point, (3, nv)."""
        jacobian = np.zeros((3, self.oracle.nv))
        mujoco.mj_jac(self.oracle, self.data, jacobian, None, point, body)
        return jacobian

    def _add(
        self,
        point,
        normal,
        gap,
        share,
        ends,
        friction,
        bodies=2,
        ratio=None,
        grip=None,
        sign=1.0,
        name=None,
    ):
        """Adds a contact, if it may act within the step."""
        c = self.scene.contact
        h = self.scene.discretization.timestep
        first, other = (self.jac(point, body) for body in ends)
        frame = np.linalg.svd(normal[None])[2]
        frame[0] = normal
        jac = frame @ (first - other)
        speed = jac @ self.data.qvel
        if gap >= max(0.002, -h * speed[0]):
            return
        stiffness = c.normal_stiffness * share * 2 / bodies
        mass = stiffness * h * (h + c.dissipation_time)
        creep = stiffness * h * 0.04 * (c.friction_ratio if ratio is None else ratio)
        reference = -speed / h
        reference[0] -= gap / (h * (h + c.dissipation_time) if gap < 0 else h * h)
        if grip is not None:  # a share of the elastic normal force, which it is held by
            elastic = stiffness * max(-gap, 0)
            reference[1:] -= elastic / creep * (frame[1:] @ grip)
            self.held.append((len(self.rows), frame, elastic, grip, sign, name))
        self.rows.append((jac, reference, 1 / np.array([mass, creep]), friction))
        self.num_hull += 1

    def solve(self):
        """Accelerations where the gradient vanishes, by SciPy."""
        start = np.linalg.solve(self.mass, self.smooth)
        factor = np.linalg.cholesky(self.mass)  # in these coordinates the smooth part is round
        back = np.linalg.inv(factor).T

        def parts(y):
            value = 0.5 * y @ y
            grad = y.copy()
            hess = np.eye(len(y))
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
    n = z[0]
    t = z[1:]
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
    """A step's problem with the contacts of fingers with each other, themselves and the palm."""

    def __init__(self, scene, oracle, data, hand, grip=None, finger_grips=None, holds=None):
        """As `Dense`.

        grip: Friction coefficient that the first of two fingers uses on the second one, (3,).
        finger_grips: That each finger's outer part uses on its inner one, (finger, 3).
        """
        super().__init__(scene, oracle, data, hand, holds)
        self.grip = grip
        self.finger_grips = finger_grips
        self.pairs = self.on_palm = self.itself = self.ahead = 0
        self.sides = {}
        for f, finger in enumerate(self.fingers):
            for ring in finger.rings:
                # Not within a quarter of the length from the base, nor within a section's height.
                free = ring.link >= np.ceil(finger.links / 4)
                free &= ring.along * finger.segment >= finger.height
                if scene.effects.finger_palm and free:
                    self._on_palm(f, ring)
                if scene.effects.finger_itself:
                    self._on_itself(f, ring)
                for g in range(scene.num_fingers):
                    if scene.effects.finger_finger and f < g:
                        self._on_finger(f, g, ring)

    def _count(self, name, before, *fingers):
        setattr(self, name, getattr(self, name) + len(self.rows) - before)
        self.sides |= {row: fingers for row in range(before, len(self.rows))}

    def normal_forces(self, size):
        """Sums by first and second finger, or a size less one for the palm, in the solution."""
        forces = np.zeros((size, size))
        for row, sides in self.sides.items():
            for ends in {sides, sides[::-1]}:
                forces[ends] += self.force(row)[0]
        return forces

    def _on_palm(self, f, ring):
        c = self.scene.contact
        palm = self.data.body("palm")
        before = len(self.rows)
        frame = palm.xmat.reshape(3, 3)

        def field(point):
            gap, normal = from_disc(self.scene.hand.palm, (point - palm.xpos) @ frame)
            return gap, frame @ normal

        point, normal, gap, share = on_field(ring, field)
        share = share * c.finger_palm_stiffness / c.normal_stiffness
        rest = c.finger_palm_friction, 2, c.finger_finger_friction_ratio
        self._add(point, normal, gap, share, (ring.body, palm.id), *rest)
        self._count("on_palm", before, f, -1)
        self.ahead += len(self.rows) > before and gap > 0

    def _on_itself(self, f, ring):
        c = self.scene.contact
        finger = self.fingers[f]
        before = len(self.rows)
        end = ring.along - max(3.0, 1.8 * finger.height / finger.segment)
        if end >= 0.5:
            point, normal, gap, share, body = between(ring, finger, 0.5, end)
            grip = None if self.finger_grips is None else self.finger_grips[f]
            rest = c.finger_finger_friction, 2, c.finger_finger_friction_ratio, grip, 1.0, f
            self._add(point, normal, gap, share, (ring.body, body), *rest)
        self._count("itself", before, f, f)

    def _on_finger(self, f, g, ring):
        c = self.scene.contact
        before = len(self.rows)
        point, normal, gap, share, body = between(ring, self.fingers[g], 0.0, self.fingers[g].links)
        rest = c.finger_finger_friction, 2, c.finger_finger_friction_ratio, self.grip, 1.0, "two"
        self._add(point, normal, gap, share, (ring.body, body), *rest)
        self._count("pairs", before, f, g)

    def next_holds(self):
        """What contacts with object and table use in the solution, by name."""
        names = {name for *_, name in self.held if isinstance(name, tuple) or name == "lowest"}
        grips = {name: self.next_grip(name) for name in names}
        on_object = {name: isinstance(name, tuple) and name[2] for name in names}
        return {n: self.turn.T @ g if on_object[n] else g for n, g in grips.items()}

    def next_grip(self, name="two"):
        """What the first finger uses in the solution: tangential over normal forces, or elastic."""
        above = below = 0.0
        for row, frame, elastic, grip, sign, label in self.held:
            if label != name:
                continue
            force = self.force(row)
            weight = max(force[0], elastic)
            tangential = weight * frame[0] * (frame[0] @ grip) - frame[1:].T @ force[1:]
            above = above + sign * tangential
            below = below + weight
        return above / below if below else np.zeros(3)


class Ring(NamedTuple):
    """A ring: body and number of its link, place along the finger in links, and its shape."""

    body: int
    link: int
    along: float
    centre: np.ndarray
    frame: np.ndarray
    half: np.ndarray
    length: float
    tip: bool


class Rings:
    """A finger's rings and its centre line, from MuJoCo's poses of its links."""

    def __init__(self, scene, data, hand, f):
        lay = layout(scene)
        width = scene.hand.section.width
        k = scene.discretization.hull_rings
        self.bodies = [lay.stubs[f], *lay.bodies[f]]
        self.links = lay.links
        self.height = float(hand.height[f])
        self.segment = float(hand.length[f]) / lay.links
        self.frames = [data.xmat[b].reshape(3, 3) for b in self.bodies]
        self.rings = []
        for link in range(1, lay.links + 1):
            last = link == lay.links
            for j in range(k):
                tip = last and j == k - 1
                size = (0.5 if last else 1.0) / k
                at = 0.25 if tip else (j + 0.5) * size
                half = np.array([0.25 if tip else 0.6 * size, 0, 0]) * self.segment
                half[1:] = width / 2, self.height / 2
                body = self.bodies[link]
                frame = self.frames[link]
                centre = data.xpos[body] + frame @ [at * self.segment, 0, self.height / 2]
                ring = body, link, link - 0.5 + at, centre, frame, half, size * self.segment / width
                self.rings.append(Ring(*ring, tip))
        up = [f[:, 2] * self.height / 2 for f in self.frames]
        joints = [data.xpos[b] for b in self.bodies]
        self.points = [joints[0] + up[0]]
        self.points += [joints[i] + (up[i - 1] + up[i]) / 2 for i in range(1, lay.links + 1)] + [
            self.rings[-1].centre
        ]
        self.places = np.array([0.0, *(np.arange(lay.links) + 0.5), self.rings[-1].along])

    def section(self, i, t):
        """Orthonormal frame of the section at a share t of segment i."""
        near = min(max(i + (1 if t >= 0.5 else -1), 0), self.links)
        mean = self.frames[i] + abs(t - 0.5) * (self.frames[near] - self.frames[i])
        x = mean[:, 0] / np.linalg.norm(mean[:, 0])
        y = mean[:, 1] - (mean[:, 1] @ x) * x
        y /= np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)], 1)

    def nearest(self, point, low, high):
        """Segment and share of it that is nearest to a point, between two places along."""
        best = ()
        for i, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False)):
            start, end = self.places[i : i + 2]
            if i == 0 and low > 0:
                continue  # of a finger itself the half link at the palm does not count
            ends = np.clip((np.array([low, high]) - start) / (end - start), 0, 1)
            if high < start or low > end:
                continue
            t = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), *ends)
            square = ((point - a - t * (b - a)) ** 2).sum()
            if not best or square < (1 - 1e-4) * best[0]:
                best = square, i, t
        return best[1:]


def reach(half, direction):
    """Support of |x/e|^4 + |y/a|^4 + |z/b|^4 = 1 in a direction, and where it is reached."""
    along = half * direction
    largest = np.linalg.norm(along)
    unit = along / largest
    size = largest * ((unit**2 + FLOOR) ** (2 / 3)).sum() ** 0.75
    return size, along / size


def cap(unit, u):
    """Area of the cap of |y|^4 + |z|^4 = 1 at the relative depth u; see docs/hull.md."""
    y, z = np.sqrt(unit[1:] ** 2 + FLOOR)
    t = min(y, z) / max(y, z)
    face = 2.26 * u**1.25 * (1 - 0.11 * u)
    edge = 1.56 * u**1.5 * (1 + 0.1 * u)
    return edge + (face - edge) / (1 + (t / (0.5 * u ** (2 / 3))) ** 2)


def secant(ring, size, unit, axial, gap):
    """Share of the scene's stiffness of a ring at a gap."""
    depth = max(-gap, 0.5e-3)
    u = min(depth / size, 1)
    _, a, b = ring.half
    side = ring.length * b / 2 * cap(unit, u) / depth
    end = 2.6 * a * b * np.sqrt(u) / (2 * a) ** 2
    ahead = max(axial, 0) ** 2 if ring.tip else 0.0
    return (1 - ahead) * side + ahead * end


def centre_of(ring, size, unit, gap):
    """Centre of the cap, from the ring's centre."""
    eps = 1.15 * (min(max(-gap, 0) / size, 1) + FLOOR) ** 0.75
    return ring.frame @ (ring.half * unit / np.cbrt(unit**2 + eps**2))


def own_normal(half, local):
    """Outward normal of a section where a ray leaves it."""
    out = np.array([0.0, local[1] ** 3 / half[1] ** 4, local[2] ** 3 / half[2] ** 4])
    return out / np.linalg.norm(out)


def on_field(ring, field):
    """Point, normal, gap and share of a ring on what a distance field describes."""
    first, slope = field(ring.centre)
    offset = np.zeros(3)
    if first > 0 and not ring.tip:
        local = -first * ring.frame.T @ slope
        local[0] = 0
        offset = ring.frame @ (local - np.linalg.norm(local) * own_normal(ring.half, local))
    gap, normal = field(ring.centre + offset)
    toward = -ring.frame.T @ normal
    size, unit = reach(ring.half, toward)
    gap = gap - normal @ offset - size
    point = ring.centre + centre_of(ring, size, unit, gap) - gap / 2 * normal
    return point, normal, gap, secant(ring, size, unit, toward[0], gap)


def between(ring, other, low, high):
    """Point, normal, gap and share of a ring on a finger's centre line; and its body there."""
    i, t = other.nearest(ring.centre, low, high)
    a, b = other.points[i : i + 2]
    away = ring.centre - a - t * (b - a)
    section = other.section(i, t)
    apart = np.linalg.norm(away)
    line = away / apart
    normal = 0.0
    half = np.array([other.rings[-1].half[0] if i == other.links else 0.0, *ring.half[1:]])
    half[1:] = other.rings[-1].half[1:]
    for frame, size, sign in ((ring.frame, ring.half, -1), (section, half, 1)):
        face_normal = sign * frame @ own_normal(size, sign * frame.T @ away)
        along = (line @ frame[:, 0]) ** 2
        normal = normal + (1 - along) * face_normal + along * line
    normal = normal / np.linalg.norm(normal)
    back = section.T @ normal
    toward = -ring.frame.T @ normal
    if t < 1 or back[0] <= 0:
        half[0] = 0.0
    size, unit = reach(ring.half, toward)
    gap = normal @ away - size - reach(half, back)[0]
    fade = apart / np.hypot(apart, 1e-3)
    share = fade * secant(ring, size, unit, toward[0], gap / 2)
    point = ring.centre + centre_of(ring, size, unit, gap) - gap / 2 * normal
    return point, normal, gap, share, other.bodies[i]


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
