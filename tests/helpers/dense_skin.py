"""Contact of a finger from first principles: an elastic skin in many small pieces.

The skin has the stiffness `per_area` [N/m^3] everywhere on the section's outline
|y/a|^4 + |z/b|^4 = 1, which is swept along the blended links and closed by a cap over the last
quarter of a segment.  On a distance field each piece is pushed along the field's gradient by its
area, stiffness and depth.  Two straight fingers share a pressure, as two skins in touch do: the
force is the stiffness times the volume in which they overlap, and acts at the volume's centre.
"""

from typing import NamedTuple

import numpy as np

UPRIGHT = np.eye(3)


class Finger(NamedTuple):
    """A finger of N links: joints (N, 3), and the frames (columns) of the half link at its base and
    of all links (N + 1, 3, 3).  Its section reaches from z = 0 to its height."""

    length: float
    width: float
    height: float
    joints: np.ndarray
    frames: np.ndarray

    @property
    def segment(self):
        """Length of a link [m]."""
        return self.length / len(self.joints)

    @property
    def base(self):
        """The middle of its bottom at the palm."""
        return self.joints[0] - self.frames[0][:, 0] * self.segment / 2

    @property
    def half(self):
        """Half axes of its cap: its length, half the width, half the height [m]."""
        return np.array([self.segment / 2, self.width, self.height]) / 2


def turned(axis, angle):
    """Rotation about an axis, columns."""
    x = np.cross(np.eye(3), np.asarray(axis, float))
    return np.eye(3) + np.sin(angle) * x + (1 - np.cos(angle)) * x @ x


def finger(length, width=0.024, height=0.020, base=(0, 0, 0), turn=UPRIGHT, bend=0.0, links=10):
    """A finger from its base, all of whose joints bend by the same angle towards z = 0."""
    segment = length / links
    each = turned([0, 1, 0], bend)
    frames = [np.asarray(turn, float)]
    joints = [np.asarray(base) + turn[:, 0] * segment / 2]
    for _ in range(links):
        frames.append(frames[-1] @ each)
        joints.append(joints[-1] + segment * frames[-1][:, 0])
    return Finger(length, width, height, np.array(joints[:-1]), np.array(frames))


def place(body, along, across, up):
    """Skinned places of points of the straight finger, arrays of one shape; (..., 3)."""
    segment = body.segment
    row = np.clip(np.ceil(along / segment - 1e-9).astype(int) - 1, 0, len(body.joints) - 1)
    local = np.stack([along - (row + 0.5) * segment, across, up], -1)[..., None]
    before, after = ((body.frames[row + i] @ local)[..., 0] for i in (0, 1))
    share = np.clip(along / segment - row, 0, 1)[..., None]
    return body.joints[row] + before + share * (after - before)


def outline(points):
    """Points of |y|^4 + |z|^4 = 1 at equal distances along it, the first also the last."""
    t = np.linspace(0, 2 * np.pi, 4001)
    circle = np.stack([np.cos(t), np.sin(t)])
    circle /= (circle**4).sum(0) ** 0.25
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(circle), axis=0)))
    even = np.linspace(0, way[-1], points + 1)
    return np.stack([np.interp(even, way, c) for c in circle], 1)


def skin(body, low=0.0, high=None, along=160, around=160):
    """Middles (piece, 3) and areas (piece,) of the pieces of a finger's skin.

    Args:
      body: The finger.
      low: Place along it where the skin begins [m].
      high: Where it ends; None for the tip with its cap.
      along: Pieces along it, without the cap.
      around: Pieces around it.
    """
    ring = outline(around)
    tip, a, b = body.half
    angle = np.linspace(0, np.pi / 2, 1 if high else 33)
    end = high or body.length - tip
    x = np.append(np.linspace(low, end, along + 1)[:-1], end + tip * np.sqrt(np.sin(angle)))
    scale = np.append(np.ones(along), np.sqrt(np.cos(angle)))
    grid = np.broadcast_arrays(
        x[:, None], a * scale[:, None] * ring[:, 0], b * (1 + scale[:, None] * ring[:, 1])
    )
    p = place(body, *grid)
    first = p[1:, 1:] - p[:-1, :-1]
    second = p[1:, :-1] - p[:-1, 1:]
    area = np.linalg.norm(np.cross(first, second), axis=-1) / 2
    middle = (p[1:, 1:] + p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:]) / 4
    return middle.reshape(-1, 3), area.ravel()


class Push(NamedTuple):
    """Force on a finger [N], its moment about the origin [N m], and the largest depth [m]."""

    force: np.ndarray
    moment: np.ndarray
    depth: float


def on_field(body, field, per_area, **pieces):
    """The push of a distance field: points (..., 3) to distances and unit gradients."""
    point, area = skin(body, **pieces)
    distance, gradient = field(point)
    each = (per_area * area * np.maximum(-distance, 0))[:, None] * gradient
    return Push(each.sum(0), np.cross(point, each).sum(0), max(0.0, -distance.min()))


def inside(body, point):
    """Whether points are in a straight finger, and the unit gradient of its level."""
    turn = body.frames[0]
    tip = body.half
    local = (point - body.base) @ turn - [body.length - tip[0], 0, tip[2]]
    unit = np.maximum(local, [0, -np.inf, -np.inf]) / tip
    square = unit * unit
    slope = square * unit / tip
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    within = (local[:, 0] > tip[0] - body.length) & ((square * square).sum(1) < 1)
    return within, slope @ turn.T


def on_finger(body, other, per_area, cells=40):
    """The push of another straight finger: `per_area` times the volume of the overlap.

    It is summed over cells of a box around the overlap, which is found with coarse ones first.  Its
    direction is the mean of both sides' normals.
    """
    turn = body.frames[0]
    low = np.array([0, -body.half[1], 0])
    high = np.array([body.length, body.half[1], 2 * body.half[2]])
    for counts in ((20, 60, 60), (20, 60, 60), (cells,) * 3):
        step = (high - low) / counts
        axes = [lo + s * (np.arange(n) + 0.5) for lo, s, n in zip(low, step, counts, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        point = body.base + grid @ turn.T
        ours, outward = inside(body, point)
        theirs, away = inside(other, point)
        both = ours & theirs
        if not both.any():
            return Push(np.zeros(3), np.zeros(3), 0.0)
        low = grid[both].min(0) - step
        high = grid[both].max(0) + step
    point = point[both]
    normal = (away - outward)[both].sum(0)
    normal /= np.linalg.norm(normal)
    force = per_area * np.prod(step) * len(point) * normal
    return Push(force, np.cross(point.mean(0), force), float(np.ptp(point @ normal)))


# Distance fields


def half_space(point, normal):
    """Below a plane through a point with an outward normal."""
    return lambda x: ((x - point) @ normal, np.broadcast_to(normal, x.shape))


def ball(centre, radius):
    """A ball."""

    def field(x):
        away = x - centre
        far = np.linalg.norm(away, axis=-1, keepdims=True)
        return far[..., 0] - radius, away / np.maximum(far, 1e-12)

    return field


def cylinder(centre, axis, radius):
    """An endless cylinder."""

    def field(x):
        away = x - centre
        away = away - (away @ axis)[..., None] * axis
        far = np.linalg.norm(away, axis=-1, keepdims=True)
        return far[..., 0] - radius, away / np.maximum(far, 1e-12)

    return field


def box(centre, turn, half):
    """A box with half sizes along the columns of `turn`."""

    def field(x):
        local = (x - centre) @ turn
        beyond = np.abs(local) - half
        out = np.maximum(beyond, 0)
        far = np.linalg.norm(out, axis=-1)
        nearest = np.eye(3)[beyond.argmax(-1)]
        outside = (far > 0)[..., None]
        gradient = np.where(outside, out / np.maximum(far, 1e-12)[..., None], nearest)
        gradient = gradient * np.where(local < 0, -1.0, 1.0)
        return np.where(far > 0, far, beyond.max(-1)), gradient @ turn.T

    return field
