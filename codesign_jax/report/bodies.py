"""A grasp as meshes and motions: what a viewer needs to draw it at any time.

Every vertex follows two bodies by linear blend skinning; those of rigid parts follow one.  Fingers
are hulls (`codesign_jax.model.hull`), whatever surface the scene's contacts have.  Where sections
grow with their pressure, what is on a finger's links grows as its contacts do.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh

from codesign_jax import model, section_sizes
from codesign_jax.model import hull
from codesign_jax.model.layout import mounts
from codesign_jax.report.replay import Replay
from codesign_jax.scene import Scene
from codesign_jax.scene.primitives import PRIMITIVES
from codesign_jax.scene.tables import Fixture
from codesign_jax.types import Tip

FINGERS = ("#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#b59f00", "#5a4fa0", "#5a6776")
"""Colours of the fingers in pictures, plots and pages, which repeat.

Those of Okabe and Ito (Color Universal Design, 2008) without orange, which the object has, their
yellow darker for lines on white; then two of ours.
"""
OBJECT = (0.95, 0.58, 0.20)
PALM = (0.36, 0.38, 0.43)
SEAT = (0.50, 0.53, 0.58)
TUBE = (0.80, 0.84, 0.88)
FIXTURE = (0.62, 0.60, 0.55)
# What is drawn of the mounting, all ours [m]: length of a seat and its walls, radius of a tube, and
# radius and length of the wrist's stump.
_SEAT = 0.016
_CHEEK = 0.002
_TUBE = 0.002
_STUMP = (0.018, 0.07)
_MOST_FACES = 40_000
"""Faces of an object's mesh above which a coarser one is drawn: pages are to stay small."""


class Part(NamedTuple):
    """A skinned mesh."""

    name: str  # name, such as "finger 0", "palm" or "object"
    color: tuple[float, float, float]  # red, green and blue, from 0 to 1
    first: np.ndarray  # vertices in the frame of their first body [m], shape (vertex, 3)
    second: np.ndarray  # the same in the frame of their second body, same shape
    body: np.ndarray  # rows of `Motion.pose` that the vertices follow, shape (vertex, 2)
    # Weight of the second body, shape (vertex,); that of the first is the rest to 1
    weight: np.ndarray
    face: np.ndarray  # vertices of the triangles, counter-clockwise from outside, shape (face, 3)


class Motion(NamedTuple):
    """Poses of all bodies over time, and sizes of what is on them."""

    # Position [m] and unit quaternion (w, x, y, z) in the world, shape (time, body, 7)
    pose: np.ndarray
    # Width (y) and height (z) over those of the part's mesh, shape (time, body, 2), see
    # `section_sizes.of_bodies`
    size: np.ndarray
    rate: float  # frames of a second


def finger_color(finger: int) -> str:
    """The colour of a finger as CSS writes it."""
    return FINGERS[finger % len(FINGERS)]


def finer(scene: Scene, rings: int, points: int) -> Scene:
    """The scene with at least so many rings of a link and points of a ring in its skin's mesh."""
    d = scene.discretization
    mesh = {"hull_rings": max(d.hull_rings, rings), "hull_points": max(d.hull_points, points)}
    return dataclasses.replace(scene, discretization=dataclasses.replace(d, **mesh))


def parts(scene: Scene, grasp: Replay) -> list[Part]:
    """Meshes of fingers, palm and object; bodies are numbered as in MuJoCo's model.

    The fingers come first, in order, then their seats and tubes, the wrist, the palm, fixtures and
    last the object.  Seats, tubes and wrist are for the eye: nothing of them is simulated.
    """
    lay = model.layout(scene)
    palm = scene.hand.palm
    bodies = [_finger(scene, grasp, f, lay) for f in range(scene.num_fingers)]
    bodies += _mounting(scene, grasp)
    disc = PRIMITIVES["cylinder"].triangles((palm.radius, palm.thickness / 2))
    disc.apply_translation([0, 0, palm.thickness / 2])
    bodies.append(_rigid("palm", PALM, disc.vertices, disc.faces, 1))
    for fixture in scene.fixture:
        bodies += _fixture(fixture)
    vertices, faces = object_mesh(scene, int(grasp.trial.shape))
    return [
        *bodies,
        _rigid("object", OBJECT, vertices * float(grasp.trial.size), faces, lay.object),
    ]


def motion(scene: Scene, grasp: Replay, *, rate: float = 25.0) -> Motion:
    """Poses at about so many frames of a second: the nearest that whole time steps allow."""
    h = scene.discretization.timestep
    every = max(1, round(1 / (rate * h)))
    return Motion(*at_steps(scene, grasp, np.arange(0, len(grasp.qpos), every)), 1 / (every * h))


def at_steps(scene: Scene, grasp: Replay, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses and sizes of all bodies at time steps, by MuJoCo's kinematics; see `Motion`."""
    compiled = model.compile_model(scene, grasp.params, grasp.trial)
    data = mujoco.MjData(compiled)
    poses = []
    for q in grasp.qpos[steps]:
        data.qpos[:] = q
        mujoco.mj_kinematics(compiled, data)
        poses.append(np.concatenate([data.xpos, data.xquat], 1))
    ctrl = grasp.trace and grasp.trace.ctrl
    size = section_sizes.of_bodies(scene, grasp.params, grasp.trial, ctrl)
    return np.array(poses, np.float32), size[steps].astype(np.float32)


def object_mesh(scene: Scene, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Surface of an object of the set, without noise, in its body's frame.

    Returns:
      Vertices [m], shape (vertex, 3), and triangles, shape (face, 3).
    """
    shape = scene.objects.object[index]
    if shape.mesh:
        return _coarse(shape.mesh.vertices, shape.mesh.faces)
    body = shape.primitive.triangles(shape.half_sizes)
    return np.asarray(body.vertices), np.asarray(body.faces)


def vertices(part: Part, pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Vertices of a part in the world [m], shape (vertex, 3).

    Args:
      pose: Poses of the bodies, shape (body, 7).
      size: Width and height of what is on them, shape (body, 2), see `Motion`.
    """
    turn = np.zeros((len(pose), 9))
    for body, quat in enumerate(pose[:, 3:]):
        mujoco.mju_quat2Mat(turn[body], quat.astype(float))
    turn = turn.reshape(-1, 3, 3)
    place = pose[:, :3]
    scale = np.insert(size, 0, 1.0, axis=1)  # nothing grows along a finger
    placed = [
        place[b] + np.einsum("vij,vj->vi", turn[b], scale[b] * local)
        for b, local in zip(part.body.T, (part.first, part.second), strict=True)
    ]
    return (1 - part.weight[:, None]) * placed[0] + part.weight[:, None] * placed[1]


def _finger(scene: Scene, grasp: Replay, f: int, lay: model.Layout) -> Part:
    length = float(grasp.params.length[f])
    height = float(grasp.params.height[f])
    tip = grasp.params.tip
    tip = None if tip is None else Tip(*(float(v[f]) for v in tip))
    mesh = hull.hull(scene)
    straight = hull.rest(scene, length, height, tip=tip)
    along = np.zeros((2, *straight.shape))
    along[..., 0] = hull.link_origins(scene, length)[mesh.link.T]
    bodies = np.array([lay.stubs[f], *lay.bodies[f]])
    first, second = straight - along
    return Part(
        f"finger {f}",
        _rgb(finger_color(f)),
        first,
        second,
        bodies[mesh.link],
        mesh.weight[:, 1],
        mesh.face,
    )


def _mounting(scene: Scene, grasp: Replay) -> list[Part]:
    """Seats and tubes of the fingers and the stump of the wrist, rigid in the palm's frame."""
    thick = scene.hand.palm.thickness
    position, quaternion = (np.asarray(v) for v in mounts(scene.hand, grasp.params.spread))
    present = np.flatnonzero(np.asarray(grasp.params.length) > 0)  # others were left out
    mounting = []
    for f in present:
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, quaternion[f].astype(float))
        frame = turn.reshape(3, 3), position[f]
        height = float(grasp.params.height[f])
        seat = _seat(scene.hand.section.width, height, *frame)
        tube = _finger_tube(height, thick + _STUMP[1], *frame)
        mounting += [
            _rigid(f"seat {f}", SEAT, seat.vertices, seat.faces, 1),
            _rigid(f"tube {f}", TUBE, tube.vertices, tube.faces, 1),
        ]
    stump = trimesh.creation.cylinder(_STUMP[0], _STUMP[1], sections=32)
    stump.apply_translation([0, 0, thick + _STUMP[1] / 2])
    return [*mounting, _rigid("wrist", SEAT, stump.vertices, stump.faces, 1)]


def _seat(width: float, height: float, turn: np.ndarray, place: np.ndarray) -> trimesh.Trimesh:
    """The box around a finger's root, by the frame of the finger's base."""
    box = trimesh.creation.box((_SEAT, width + 2 * _CHEEK, height + 2 * _CHEEK))
    middle = np.array([_CHEEK - _SEAT / 2, 0, height / 2])
    return trimesh.Trimesh((box.vertices + middle) @ turn.T + place, box.faces)


def _finger_tube(height: float, top: float, turn: np.ndarray, place: np.ndarray) -> trimesh.Trimesh:
    """The tube from behind a finger's root up along the wrist, to a height above the palm."""
    start = place + turn @ [_CHEEK - _SEAT, 0, height / 2]
    behind = start + turn @ [-0.015, 0, 0]
    away = np.array([*place[:2], 0]) / max(np.hypot(*place[:2]), 1e-9)
    end = (_STUMP[0] + _TUBE) * away + [0, 0, top]
    return _tube(_curve(start, behind, end - [0, 0, 0.03], end))


def _curve(*points: np.ndarray) -> np.ndarray:
    """A cubic Bézier curve by its four points, shape (place, 3)."""
    t = np.linspace(0, 1, 12)[:, None]
    weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3)
    return sum(w * p for w, p in zip(weights, points, strict=True))  # type: ignore[return-value]


def _tube(path: np.ndarray) -> trimesh.Trimesh:
    """A tube along a path, with open ends."""
    sides = 8
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, [0.37, 0.61, 0.70])  # a direction that no tube has
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(sides)[:, None, None] / sides
    rings = path + _TUBE * (np.cos(angle) * across + np.sin(angle) * np.cross(along, across))
    vertices = rings.swapaxes(0, 1).reshape(-1, 3)
    first = sides * np.arange(len(path) - 1)[:, None]
    k = np.arange(sides)
    a, b = first + k, first + (k + 1) % sides
    faces = np.stack([np.stack([a, b, b + sides], -1), np.stack([a, b + sides, a + sides], -1)])
    return trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)


def _fixture(fixture: Fixture) -> list[Part]:
    """A fixture; of a plane nothing is drawn."""
    if fixture.type == "plane":
        return []
    body = PRIMITIVES[fixture.type].triangles(fixture.half_sizes)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array(fixture.quaternion))
    vertices = body.vertices @ turn.reshape(3, 3).T + fixture.position
    return [_rigid(fixture.name, FIXTURE, vertices, np.asarray(body.faces), 0)]


def _rgb(color: str) -> tuple[float, float, float]:
    red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


def _rigid(name: str, color, vertices: np.ndarray, faces: np.ndarray, body: int) -> Part:
    rows = np.full((len(vertices), 2), body)
    return Part(name, color, vertices, vertices, rows, np.zeros(len(vertices)), faces)


def _coarse(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cells = 200
    while len(faces) > _MOST_FACES:
        cell = np.ptp(vertices, axis=0).max() / cells
        _, index, merged = np.unique(
            np.floor(vertices / cell), axis=0, return_index=True, return_inverse=True
        )
        faces = merged.ravel()[faces]
        sides = np.roll(faces, 1, axis=1)
        vertices = vertices[index]
        faces = faces[(faces != sides).all(1)]
        cells = cells * 3 // 4
    return vertices, faces
