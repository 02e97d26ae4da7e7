"""Hard cases 21 and 22: a scene that is mirrored, turned or larger is the same scene."""

import dataclasses
import functools

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax import model
from codesign_jax.scene import hand
from tests.helpers import grasps
from tests.stability.bench import bench, pinch
from tests.stability.table import BOTH, Found, case

LIFTED = 4.5
"""End of the lift [s]: the object hangs in the hand.  The shaking would turn the arm, whose Euler
angles are not covariant."""

INFLATED = 3.5
"""End of inflation [s]: the fingers hold the object."""

EXACT = {"solver__tolerance": 1e-16, "solver__iterations": 100}
EXACTLY = {"float32": 1e-10, "float64": 1e-24}
"""Newton decrement of the structured engine at which only rounding is left."""

SUNK = 1e-4
"""Depth of the object in the table at the start [m]: at zero, rounding decides whether they touch,
and an object that falls for a step is g h^2 = 1 mm lower."""

SAME = {"float32": 1e-4, "float64": 1e-9}
"""Largest difference of places [m or rad].  In float32 the object is 0.2 m below the palm, whose
frame the engine computes in."""


@functools.cache
def rigid():
    """Without the wrist, whose springs act on Euler angles: no frame is special."""
    return pinch(effects__wrist=False, **EXACT)


def asymmetric(b):
    """Fields, controls and start of a grasp off the middle, tilted and turned, without spread."""
    params, trial = grasps.hand_world(b.scene, length=0.09, pressure=190e3, spread=0.0)
    params = params._replace(
        length=np.array([0.090, 0.094]), arm=params.arm + 0.05 * (np.arange(6) == 2)
    )
    trial = trial._replace(
        position=np.array([0.003, 0.002]), yaw=np.array(0.2), arm_tilt=np.array([0.05, 0.03])
    )
    fields = b.fields([params], [trial])
    fields.start[0, -5] -= SUNK
    return fields, b.commands([params], [trial])[:, : round(LIFTED / b.h)]


def compare(b, image, engine_places, bound=None) -> Found:
    """Runs a grasp and its image, both at rest at the start.

    Args:
      b: The bench.
      image: Function of poses (..., 6) of the wrist and of qpos to those of the image.
      engine_places: Function of qpos of the first run to qpos of the second one.
      bound: Bound on the difference instead of `SAME`.
    """
    fields, ctrl = asymmetric(b)
    turned = ctrl.copy()
    turned[..., :6] = image(ctrl[..., :6])
    start = engine_places(fields.start)
    one, two = b.run(fields, ctrl), b.run(fields, turned, start)
    difference = np.abs(engine_places(one.qpos) - two.qpos).max()
    lifted = one.object[0, -1, 2] - one.object[0, 0, 2]
    assert lifted > 0.1, "the object stayed behind: the case would be vacuous"
    bound = bound or SAME["float64" if b.wide else "float32"]
    return Found(difference, bound, "to the end of the lift")


def mirror_pose(pose):
    """y to -y: a pose (..., x, y, z, roll, yaw, pitch)."""
    return pose * np.array([1, -1, 1, -1, -1, 1])


SAME_SCENE = {"unit": "m or rad", "engines": BOTH, "quick": "mujoco"}
DIFFERENCE = "largest difference of places"


@case(21, "mirrored scene", DIFFERENCE, **SAME_SCENE)
def mirrored(engine, step, precision):
    """Mirrored in the plane of the two fingers: each is its own image."""
    b = bench(rigid(), engine, step, precision, EXACTLY[precision])
    dofs = model.layout(b.scene).dofs

    def places(qpos):
        found = np.array(qpos, float)
        found[..., :6] = mirror_pose(found[..., :6])
        found[..., dofs[..., 1:].ravel()] *= -1  # lateral bending and twist
        found[..., -7:] *= [1, -1, 1, 1, -1, 1, -1]
        return found

    return compare(b, mirror_pose, places)


TURN = Rotation.from_euler("z", 37, degrees=True)


def turn_pose(pose):
    """A pose about the vertical axis through the origin."""
    flat = np.reshape(pose, (-1, 6))
    turned = (TURN * Rotation.from_euler("XZY", flat[:, 3:])).as_euler("XZY")
    return np.concatenate([TURN.apply(flat[:, :3]), turned], 1).reshape(np.shape(pose))


@case(21, "scene turned by 37 degrees", DIFFERENCE, **SAME_SCENE)
def turned(engine, step, precision):
    """Turned by 37 degrees, which no float is exact in."""
    b = bench(rigid(), engine, step, precision, EXACTLY[precision])

    def places(qpos):
        found = np.array(qpos, float)
        found[..., :6] = turn_pose(found[..., :6])
        shape, last = found.shape[:-1], found[..., -7:].reshape(-1, 7)
        spun = TURN * Rotation.from_quat(last[:, [4, 5, 6, 3]])
        quat = spun.as_quat()[:, [3, 0, 1, 2]]
        quat *= np.sign((quat * quat[:1]).sum(1))[:, None] * np.sign(quat[0, 0])
        found[..., -7:] = np.c_[TURN.apply(last[:, :3]), quat].reshape(*shape, 7)
        return found

    # MuJoCo C has a wrist of 1e9 kg in the place of none: 1e-16 of that weighs on the joints.
    return compare(b, turn_pose, places, bound=1e-6 if engine == "mujoco" else None)


def scaled_mount(finger, s):
    """The mount with its base point s times as far from the palm's centre."""
    if finger.base is None:
        return dataclasses.replace(finger, radius=s * finger.radius)
    return dataclasses.replace(finger, base=tuple(s * v for v in finger.base))


def scaled_scene(base, s):
    """The scene s times as large, gravity the same: forces s^3, stresses s, times s^(1/2)."""
    t = np.sqrt(s)
    h, o, c = base.hand, base.objects, base.contact
    fingers = tuple(scaled_mount(f, s) for f in h.finger)
    w = h.wrist
    wrist = hand.Wrist(
        s**2 * w.linear_stiffness,
        s**4 * w.angular_stiffness,
        s**2 * t * w.linear_damping,
        s**4 * t * w.angular_damping,
    )
    palm = dataclasses.replace(
        h.palm,
        mass=s**3 * h.palm.mass,
        **{
            k: s * getattr(h.palm, k)
            for k in ("radius", "thickness", "contact_radius", "contact_ring")
        },
    )
    material = dataclasses.replace(
        h.material,
        shear_modulus=s * h.material.shear_modulus,
        damping_time=t * h.material.damping_time,
    )
    section = dataclasses.replace(h.section, width=s * h.section.width)
    new_hand = dataclasses.replace(
        h, finger=fingers, wrist=wrist, palm=palm, material=material, section=section
    )
    shapes = tuple(
        dataclasses.replace(x, size=tuple(s * v for v in x.size), mass=s**3 * x.mass)
        for x in o.object
    )
    contact = dataclasses.replace(
        c,
        normal_stiffness=s**2 * c.normal_stiffness,
        dissipation_time=t * c.dissipation_time,
        friction_ratio=t * c.friction_ratio,  # of a time, see `layout.friction_ratio`
    )
    phases = {f.name: t * getattr(base.phases, f.name) for f in dataclasses.fields(base.phases)}
    arm = base.arm
    new_arm = dataclasses.replace(
        arm, start_height=s * arm.start_height, zero_height=s * arm.zero_height
    )
    return dataclasses.replace(
        base,
        hand=new_hand,
        objects=dataclasses.replace(o, object=shapes),
        contact=contact,
        phases=type(base.phases)(**phases),
        arm=dataclasses.replace(new_arm, shake_frequency=arm.shake_frequency / t),
        discretization=dataclasses.replace(
            base.discretization, timestep=t * base.discretization.timestep
        ),
    )


@functools.cache
def exact():
    """MuJoCo's tolerance has a unit, and would stop it earlier in the larger scene."""
    return pinch(**EXACT)


@functools.cache
def three_times():
    return scaled_scene(exact(), 3.0)


@case(22, "lengths times three, everything else to scale", DIFFERENCE, **SAME_SCENE)
def unit_scaling(engine, step, precision):
    """Three times as large, lengths over three: the same motion, and no number is exact."""
    found = []
    for s, base in ((1.0, exact()), (3.0, three_times())):
        b = bench(base, engine, step, precision, EXACTLY[precision])
        params, trial = grasps.hand_world(b.scene)
        arm = (
            params.arm * 0
            + np.array([0.004, 0.003, 0.05, 0.05, 0.02, 0.1]) * np.r_[[s] * 3, 1, 1, 1]
        )
        sizes = {"length": 0.09 * s, "height": 0.02 * s, "wall": 0.005 * s, "pressure": 190e3 * s}
        params = params._replace(
            arm=arm, **{k: v + 0 * getattr(params, k) for k, v in sizes.items()}
        )
        fields = b.fields([params], [trial])
        fields.start[0, -5] -= SUNK * s
        q = b.run(
            fields, b.commands([params], [trial])[:, : round(INFLATED * np.sqrt(s) / b.h)]
        ).qpos[0]
        scale = np.ones(q.shape[1])
        scale[:3], scale[-7:-4] = s, s
        found.append(q.astype(float) / scale)
    error = np.abs(found[0] - found[1]).max()
    return Found(error, SAME[precision], "to the end of inflation")
