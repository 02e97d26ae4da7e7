"""Whether a hand starts apart from everything, by bounds in NumPy: for most hands they suffice.

`engines.depths` measures the overlaps of all others, by programs that compile for seconds.
"""

import itertools

import numpy as np

from codesign_jax.model.layout import beyond_base, mount_points, sections_grow
from codesign_jax.model.morphology import growth_numbers, sections
from codesign_jax.scene import Scene, key_frames
from codesign_jax.types import Params

_PLACES = 50
"""Places along a finger [chosen]: 4 mm apart on the longest."""


def starts_apart(scene: Scene, design: Params) -> bool:
    """Whether it is certain that a hand of straight fingers overlaps with nothing at its start.

    Overlaps of fingers with one another and with the palm count as none up to half of the depth
    that the scene allows, `limits.penetration`.

    Args:
      design: Parameters of one hand, NumPy arrays.
    """
    return not scene.fixture and _hangs_above(scene, design) and _fingers_apart(scene, design)


def _hangs_above(scene: Scene, design: Params) -> bool:
    """Whether all of the hand is above the tallest object, whichever way it is turned."""
    height = float(key_frames.poses(scene, design, 1, np)[0, 2])
    section = _largest_section(scene, design)
    fingers = max(f.base_distance for f in scene.hand.finger) + design.length.max()
    reach = max(fingers + np.hypot(*section).max(), np.hypot(*_palm_size(scene)))
    return bool(height - reach > max(float(shape.height) for shape in scene.objects.object))


def _fingers_apart(scene: Scene, design: Params) -> bool:
    """Whether straight fingers are apart from one another, as spheres, and from the palm's disc."""
    base, along, across, up = _mounted(scene, design)
    width, height = _largest_section(scene, design)
    distance = np.linspace(0, 1, _PLACES) * design.length[:, None]  # (finger, place)
    axis = base[:, None] + distance[..., None] * along[:, None]
    allowed = float(scene.limits.penetration) / 2
    deepest = -np.inf
    if scene.effects.finger_finger:
        middle = axis + (height[:, None] / 2 * up)[:, None]
        for i, j in itertools.combinations(range(len(middle)), 2):
            away = np.linalg.norm(middle[i][:, None] - middle[j], axis=-1).min()
            deepest = max(deepest, (height[i] + height[j]) / 2 - away)
    if scene.effects.finger_palm:
        beyond = beyond_base(distance, height[:, None])
        for y, z in itertools.product((-0.5, 0.0, 0.5), (0.0, 0.5, 1.0)):
            corner = y * width[:, None] * across + z * height[:, None] * up
            inside = _depth_in_palm(scene, (axis + corner[:, None])[beyond])
            deepest = max(deepest, inside.max(initial=-np.inf))
    return bool(deepest <= allowed)


def _mounted(scene: Scene, design: Params) -> tuple[np.ndarray, ...]:
    """Base points of the fingers and unit vectors along, across and up, each (finger, 3).

    In the palm's frame: x of a finger's frame is turned by its tilt about y, then by its azimuth
    about z.
    """
    base, azimuth, tilt = mount_points(scene.hand, np.asarray(design.spread, float), np)
    outwards = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], -1)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], -1)
    downwards = np.array([0.0, 0.0, -1.0])
    cosine = np.cos(tilt)[..., None]
    sine = np.sin(tilt)[..., None]
    along = cosine * outwards + sine * downwards
    up = sine * outwards - cosine * downwards
    return base, along, across, up


def _depth_in_palm(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Depths of points (point, 3) in the palm's disc [m], negative outside."""
    radius, thickness = _palm_size(scene)
    x, y, z = points.T
    return np.minimum(radius - np.hypot(x, y), np.minimum(z, thickness - z))


def _largest_section(scene: Scene, design: Params) -> tuple[np.ndarray, np.ndarray]:
    """Largest outer width and height of each finger as a grasp begins [m], shape (finger,)."""
    ends = sections(scene.hand, design, np.array([0.0, 1.0]))
    sizes = [ends.width, ends.height]
    if sections_grow(scene) and not key_frames.begins_empty(scene):
        grows = growth_numbers(scene.hand, design, np.array([0.0, 1.0]))
        most = np.maximum(grows.width, 0.0), np.maximum(grows.height, 0.0)
        sizes = [size * (1 + more) for size, more in zip(sizes, most, strict=True)]
    width, height = (np.asarray(v, float).max(1) for v in np.broadcast_arrays(*sizes))
    return width, height


def _palm_size(scene: Scene) -> tuple[float, float]:
    """Radius and thickness of the palm's disc [m]."""
    return float(scene.hand.palm.radius), float(scene.hand.palm.thickness)
