"""Which designs start deep inside the table, an object or themselves, before any simulation."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import model, rollout
from codesign_jax.model.layout import first_on_palm, mount_points, palm_points
from codesign_jax.scene import Constants, Scene
from codesign_jax.start import depth
from codesign_jax.types import Params


def overlaps(scene: Scene, designs: Params) -> np.ndarray:
    """Deepest overlap of each design's start without noise [m], shape (object, design).

    If all hands start above all objects (see `lowest_point`) it is 0, or else measured by the
    engine's contacts, for which a program is compiled.

    Args:
      scene: The scene.
      designs: Parameters with leading axis (design,), NumPy arrays.
    """
    shapes = scene.objects.object
    top = max(shape.height for shape in shapes)
    low = [lowest_point(scene, Params(*one)) for one in zip(*designs, strict=True)]
    if min(low) >= top:
        return np.zeros((len(shapes), len(low)))
    return np.asarray(depths(*_arguments(scene, designs)))


def between_fingers(scene: Scene, designs: Params) -> np.ndarray:
    """Deepest overlap of two fingers at each design's start [m], shape (design,).

    As `start.depth_between` has it, which engines judge a start by: spheres around the middles of
    the links of straight fingers.  Here no program is traced for it.

    Args:
      scene: The scene.
      designs: Parameters with leading axis (design,), NumPy arrays.
    """
    if not scene.effects.finger_finger or scene.num_fingers == 1:
        return np.zeros(designs.length.shape[0])
    return np.array([_between(scene, Params(*one)) for one in zip(*designs, strict=True)])


def in_palm(scene: Scene, designs: Params) -> np.ndarray:
    """Deepest overlap of a finger with the palm's disc at each design's start [m], (design,).

    As `start.depth_in_palm` has it; arguments as in `between_fingers`.
    """
    if not scene.effects.finger_palm:
        return np.zeros(designs.length.shape[0])
    return np.array([_in_palm(scene, Params(*one)) for one in zip(*designs, strict=True)])


def _in_palm(scene: Scene, params: Params) -> float:
    """`in_palm` of one design."""
    palm, links = scene.hand.palm, scene.discretization.links
    point, radius = _middles(scene, params), 0.5 * params.height[:, None]
    if scene.effects.surface == "hull":
        base, ahead, across, back = _frames(scene, params)
        along = np.multiply.outer(params.length, (np.arange(links) + 0.5) / links)
        axis = base[:, None] + along[..., None] * ahead[:, None]
        half, up = scene.hand.section.width / 2 * across, params.height[:, None] * back
        corners = [axis + (s * half + t * up)[:, None] for s in (-1, 1) for t in (0, 1)]
        point, radius = np.stack(corners), 0.0
    point = point[..., first_on_palm(links) - 1 :, :]
    beside = np.hypot(point[..., 0], point[..., 1]) - palm.radius
    above = np.abs(point[..., 2] - palm.thickness / 2) - palm.thickness / 2
    outside = np.hypot(np.maximum(beside, 0.0), np.maximum(above, 0.0))
    distance = outside + np.minimum(np.maximum(beside, above), 0.0)
    return float((radius - distance).max())


def _frames(scene: Scene, params: Params) -> tuple[np.ndarray, ...]:
    """Base points, and directions along, across and back of the fingers, shape (finger, 3) each."""
    base, azimuth, tilt = mount_points(scene.hand, float(params.spread), np)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    ahead = np.stack([np.cos(tilt) * cosine, np.cos(tilt) * sine, -np.sin(tilt)], -1)
    back = np.stack([np.sin(tilt) * cosine, np.sin(tilt) * sine, np.cos(tilt)], -1)
    return base, ahead, np.stack([-sine, cosine, 0.0 * sine], -1), back


def _middles(scene: Scene, params: Params) -> np.ndarray:
    """Middles of the links of straight fingers in the palm's frame [m], (finger, link, 3)."""
    links = scene.discretization.links
    base, ahead, _, back = _frames(scene, params)
    # The last link is half as long as the others.
    place = (np.arange(1, links + 1) - 0.25 * (np.arange(links) == links - 1)) / links
    along = np.multiply.outer(params.length, place)[..., None] * ahead[:, None]
    return (base + 0.5 * params.height[:, None] * back)[:, None] + along


def _between(scene: Scene, params: Params) -> float:
    """`between_fingers` of one design."""
    middle, deepest = _middles(scene, params), -np.inf
    for a, b in itertools.combinations(range(scene.num_fingers), 2):
        away = np.linalg.norm(middle[a][:, None] - middle[b][None], axis=-1)
        deepest = max(deepest, 0.5 * (params.height[a] + params.height[b]) - away.min())
    return float(deepest)


def lowest_point(scene: Scene, params: Params) -> float:
    """Lower bound on the height above the table of any point of the hand at its start [m].

    Fingers are straight at the start: boxes around segments that leave the palm. The palm is turned
    by roll about x, yaw about z and pitch against y, in this order, each about the axis as turned
    by those before.

    Args:
      scene: The scene.
      params: One design, NumPy arrays.
    """
    section, palm = scene.hand.section, scene.hand.palm
    roll, pitch, yaw = (float(v) for v in params.arm[3:])
    # Heights only: the last row of the palm's orientation.
    up = (_about(0, roll) @ _about(2, yaw) @ _about(1, -pitch))[2]
    base, along, across, back = (v @ up for v in _frames(scene, params))
    ends = np.minimum(base, base + params.length * along)
    # The skin is a box between the layer that bends and the back; contact spheres fill its height.
    skin = np.minimum(params.height * back, 0.0) - section.width / 2 * np.abs(across)
    spheres = params.height / 2 * (back - 1.0)
    palm_low = (np.asarray(palm_points(scene)) @ up).min() - palm.contact_radius
    lowest = min(float((ends + np.minimum(skin, spheres)).min()), float(palm_low))
    return scene.arm.start_height + lowest


def _about(axis: int, angle: float) -> np.ndarray:
    """Rotation about a coordinate axis, shape (3, 3)."""
    matrix, (i, j) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
    matrix[[i, j], [i, j]] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def _arguments(scene: Scene, designs: Params) -> tuple[Scene, Constants, Params]:
    """What the program below takes: scenes of one structure share it."""
    numbers = jax.tree.map(np.float32, scene.constants())
    return scene.structure, numbers, Params(*(v.astype(np.float32) for v in designs))


@functools.partial(jax.jit, static_argnums=0)
def depths(scene: Scene, numbers: Constants, designs: Params) -> jax.Array:
    """`start.depth` of designs with every object, shape (object, design); one program for all."""
    own = scene.with_constants(numbers)

    def of_shape(index: jax.Array) -> jax.Array:
        trial = rollout.nominal_trial(scene)._replace(shape=index)
        return depth(scene, jax.vmap(lambda p: model.model_fields(own, p, trial))(designs))

    return jax.lax.map(of_shape, jnp.arange(len(scene.objects.object)))
