"""Hard case 35: long fingers of the default scene that curl onto the palm."""

import functools

import numpy as np

from codesign_jax import model, scene
from tests.helpers import grasps
from tests.stability.bench import bench
from tests.stability.oracle import Reader
from tests.stability.table import Found, case

HANDS = ((0.10, 80e3), (0.13, 80e3), (0.16, 80e3), (0.18, 60e3))
"""Lengths [m] and pressures [Pa] of thin fingers, which roll up within their own length."""
WALL = 2e-3
"""At this wall 80 kPa is the limit."""


@functools.cache
def default(*, palm=True):
    return scene.load("paper", overrides={"effects": {"finger_palm": palm}})


@functools.cache
def deepest(step, precision, *, palm=True):
    """How deep any finger is in the palm in two seconds of pressure, and in the end [m], by hand.

    By MuJoCo's kinematics and the disc's own distance: points of the outline at every joint, but of
    the first quarter of a finger, where it stands on the palm.
    """
    b = bench(default(palm=palm), "structured", step, precision)
    hands = []
    for length, pressure in HANDS:
        params, trial = grasps.hand_world(b.scene, length=length, wall=WALL, height=0.015)
        hands.append((params, pressure))
    fields = b.fields([h for h, _ in hands], [trial] * len(hands))
    fingers = b.scene.num_fingers
    rows = [
        np.r_[s[:6], np.full(fingers, p)] for s, (_, p) in zip(fields.start, hands, strict=True)
    ]
    ctrl = b.hold(2.0, *rows)
    ctrl[:, :, 6:] *= np.minimum(np.arange(ctrl.shape[1]) * b.h / 0.5, 1)[:, None]
    history = b.run(fields, ctrl)
    depths = []
    assert np.isfinite(history.qpos).all()
    for world, (params, _) in enumerate(hands):
        reader = Reader(b.scene, fields, world)
        stride = round(0.02 / b.h)
        path = history.qpos[world, stride - 1 :: stride]
        each = [inside(b.scene, reader.at(qpos), params) for qpos in path]
        depths.append((max(each), each[-1]))
    return np.array(depths).T


def inside(the_scene, data, params):
    """Depth of the deepest point of the fingers in the palm's disc [m]; negative above it."""
    palm = data.body("palm")
    disc = the_scene.hand.palm
    lay = model.layout(the_scene)
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    unit = np.stack([np.cos(around), np.sin(around)], 1)
    unit /= ((unit**4).sum(1) ** 0.25)[:, None]
    worst = -np.inf
    for f, bodies in enumerate(lay.bodies):
        half = np.array([the_scene.hand.section.width, params.height[f]]) / 2
        ring = np.c_[0 * unit[:, 0], unit * half + [0, half[1]]]
        for body in bodies[int(np.ceil(lay.links / 4)) :]:
            points = data.xpos[body] + ring @ data.xmat[body].reshape(3, 3).T
            x, y, z = ((points - palm.xpos) @ palm.xmat.reshape(3, 3)).T
            depth = np.minimum(disc.radius - np.hypot(x, y), np.minimum(z, disc.thickness - z))
            worst = max(worst, depth.max())
    return worst


def millimetres(depths):
    return ", ".join(f"{1e3 * d:.1f}" for d in depths) + " mm"


ONE = {"unit": "m", "precisions": ("float32",)}
CURL = (35, "fingers of the default scene curl onto the palm")


@case(
    *CURL,
    "deepest point of a finger in the palm",
    **ONE,
)
def curls(engine, step, precision):
    depths, end = deepest(step, precision)
    # The bound on winners of searches: no link more than 2 mm inside the palm.
    return Found(
        depths.max(), 2e-3, f"{millimetres(depths)} by hand, in the end {millimetres(end)}"
    )


@case(*CURL, "the same without that contact", lower=True, steps=(1.0,), **ONE)
def without(engine, step, precision):
    """The same without the contact: the case would see it missing."""
    depths, _ = deepest(step, precision, palm=False)
    return Found(depths.max(), 4e-3, f"{millimetres(depths)} by hand")
