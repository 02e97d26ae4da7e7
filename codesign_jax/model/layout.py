"""Indices of a scene's parts in the model's arrays, and numbers shared by its geometry.

Both ways to a model use it: `spec` compiles one hand with MuJoCo, `fields` computes batches of
them.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Scene, by_structure, rigid_bodies
from codesign_jax.scene.hand import Hand
from codesign_jax.scene.objects import ObjectSet, Shape
from codesign_jax.scene.primitives import PRIMITIVES
from codesign_jax.types import Trial

# Wrist hinges turn in the order roll (x), yaw (z), pitch (y).  Yaw is in the middle, where +-90
# degrees is singular, because the disturbance adds up to 40 degrees to roll and pitch but nothing
# to yaw.
WRIST = ("x", "y", "z", "roll", "yaw", "pitch")
AXES = {"bend": (0, 1, 0), "lateral": (0, 0, 1), "twist": (1, 0, 0)}
"""Axes of a finger's joints in the link's frame, in the order in which arrays have them."""


class Layout(NamedTuple):
    """Indices of a scene's parts in the model's arrays.

    Attributes:
      links: Number of segments N of a finger.
      axes: Names of the joint axes that are on, in the order of `AXES`.
      stubs: Body ids of the half segments at the palm, shape (finger,).
      bodies: Body ids of the moving links, shape (finger, N).
      object: Body id of the object.
      dofs: Dof (and joint) ids of the finger hinges, shape (finger, N, axis), the axes in the order
        of `axes`: on every other joint the ids descend, see `hinge_sign`.
      spheres: Geom ids of the finger spheres, shape (finger, N, k); empty without finger contacts.
      object_geoms: Geom ids of the object's shapes, shape (shape,).
      palm: Geom ids of the palm's contact spheres, shape (sphere,); empty without palm contacts.
      disc: Geom id of the palm's disc, which fingers touch, shape (1,); empty without that effect.
      centre_weights: Weight of each body in the hand centre, the mean position of the segments,
        (nbody,).
    """

    links: int
    axes: tuple[str, ...]
    stubs: np.ndarray
    bodies: np.ndarray
    object: int
    dofs: np.ndarray
    spheres: np.ndarray
    object_geoms: np.ndarray
    palm: np.ndarray
    disc: np.ndarray
    centre_weights: np.ndarray

    @property
    def hinges(self) -> np.ndarray:
        """Places of the finger hinges, in MuJoCo's order, in a flat array (finger, N, axis)."""
        return np.argsort(self.dofs, axis=None).astype(np.int32)


def centre_weights(lay: Layout, share: Any) -> Any:
    """Weight of each body in the hand's centre, shape (..., nbody), for `ModelFields.share`.

    Args:
      share: Arrays of JAX or NumPy, shape (..., finger).
    """
    finger = np.zeros(len(lay.centre_weights), int)
    finger[lay.stubs] = np.arange(len(lay.stubs))
    finger[lay.bodies] = np.arange(len(lay.stubs))[:, None]
    return share[..., finger] * lay.centre_weights


def joint_axes(scene: Scene) -> tuple[str, ...]:
    """Names of the finger joints' axes that the scene's effects call for, as `AXES` has them."""
    on = {"bend": True, "lateral": scene.effects.lateral_bending, "twist": scene.effects.twist}
    return tuple(name for name in AXES if on[name])


def hinge_sign(joint: Any) -> Any:
    """1 for joints whose hinges follow one another in the order of `AXES`, else -1.

    Those of every other joint follow in the opposite order.  One order in all of them couples
    bending and twist with an error of first order in 1/N: ten links of a finger that is bent by 120
    degrees give way to a sideways force by 8 % less than a fine chain; alternating, by 1 % less.

    Args:
      joint: Number of the joint along its finger, from 0; an integer or an array of them.
    """
    return 1 - 2 * (joint & 1)


def hinge_order(scene: Scene, joint: int) -> tuple[str, ...]:
    """Names of a joint's axes in the order in which its hinges follow one another."""
    return joint_axes(scene)[:: hinge_sign(joint)]


@by_structure
def layout(scene: Scene) -> Layout:
    """Returns the index layout of a scene's model."""
    n = scene.num_fingers
    links = scene.discretization.links
    axes = joint_axes(scene)
    stubs = 2 + np.arange(n) * (links + 1)
    bodies = stubs[:, None] + 1 + np.arange(links)
    dofs = 6 + np.arange(n * links * len(axes)).reshape(n, links, len(axes))
    forward = hinge_sign(np.arange(links)) > 0
    dofs = np.where(forward[:, None], dofs, dofs[:, :, ::-1])
    e = scene.effects
    fingers_touch = e.finger_object or e.finger_table or e.finger_finger or e.finger_palm
    touching = e.surface == "spheres" and fingers_touch
    k = scene.discretization.spheres_per_link if touching else 0
    still = 1 + len(scene.fixture)  # the table and the fixtures, of the world
    palm = still + np.arange(len(_PALM_RING) if palm_touches(scene) else 0)
    disc = still + len(palm) + np.arange(int(e.finger_palm))
    first = still + len(palm) + len(disc)
    spheres = first + np.arange(n * links * k).reshape(n, links, k)
    shapes = first + n * links * k + np.arange(len(scene.objects.object))
    weights = np.zeros(3 + n * (links + 1))
    weights[bodies] = 1.0 / (n * links)
    weights[[*stubs, *bodies[:, -1]]] = 0.5 / (n * links)
    last = len(weights) - 1
    # One width in every precision: JAX keeps what it made of a NumPy array, and an array of int64
    # that was met with jax_enable_x64 is an error without.
    stubs, bodies, dofs, spheres, shapes, palm, disc = (
        v.astype(np.int32) for v in (stubs, bodies, dofs, spheres, shapes, palm, disc)
    )
    return Layout(links, axes, stubs, bodies, last, dofs, spheres, shapes, palm, disc, weights)


# Implicit inertia of a wrist joint without compliance [kg, kg m^2]: forces of the hand, of at most
# 100 N, move a joint that heavy by 1e-11 m in a step.  At 1e11 rounding of its rows reaches the
# solver's decisions: 1 of 144 grasps went unstable.
RIGID = 1e9


def wrist_springs(scene: Scene) -> tuple[list[Any], list[Any]]:
    """Stiffness [N/m, N m/rad] and damping [N s/m, N m s/rad] of the wrist's joints, six each.

    Without the effect `wrist` they are the limit in which the implicit spring ends every step where
    the arm frame is: (M + h^2 K) a = K (u - q - h v) gives q + h (v + h a) = u as K grows.
    """
    w = scene.hand.wrist
    h = scene.discretization.timestep
    if not scene.effects.wrist:
        return [RIGID / h**2] * 6, [0.0] * 6
    stiffness = [w.linear_stiffness] * 3 + [w.angular_stiffness] * 3
    return stiffness, [w.linear_damping] * 3 + [w.angular_damping] * 3


NEWMARK = 1.0
"""Newmark's beta [ours]. From 1/4 on the step is stable for springs alone. Contact forces turn with
the hand. No step takes this stiffness implicitly, and it may be at most 4 beta - 1 times the
springs' stiffness. Of 180 grasps of winners at 10 ms 0.3 keeps 34, and 0.5 keeps 178 with a soft
wall but lets joints of measured rubber reach 330 rad/s. With 1 both walls move as with "euler"."""


def implicit_spring(
    scene: Scene, stiffness: Any, damping: Any, *, rigid: bool = False
) -> tuple[Any, Any]:
    """Damping C and armature A of a joint whose spring acts implicitly.

    The step solves (M + A) a = tau - K q - C v for the acceleration a, then v + h a is the new
    velocity, and q + h (v + h a) the new angle.

    * "euler": C = D + h K and A = h C, which is the implicit Euler step of spring and damper: their
      forces are those of the step's end.
    * "newmark": C = D and A = h D / 2 + beta h^2 K, which is Newmark's method with gamma = 1/2
      (Newmark 1959, J. Eng. Mech. Div. 85, 67) in its leapfrog form: forces are those of the time
      of q, and v is the velocity half a step before it.

    Both are stable at any stiffness, as 4 (M + A) - h^2 K - 2 h C is positive.

    Args:
      scene: The scene, for its integrator and time step h.
      stiffness: Stiffness K [N/m, N m/rad].
      damping: The joint's damping D [N s/m, N m s/rad], shaped as the stiffness.
      rigid: Whether the joint shall end each step at its rest: "euler", whatever the scene has.
    """
    h = scene.discretization.timestep
    if rigid or scene.discretization.integrator == "euler":
        implicit = damping + h * stiffness
        return implicit, h * implicit
    return damping, h * (0.5 * damping + NEWMARK * h * stiffness)


IMPEDANCE = 0.9
"""MuJoCo's impedance d of a contact, constant; a body's declared weight makes up for it."""
CREEP = 0.04
"""Time in which a contact of friction ratio 1 creeps by what its normal stiffness yields [s]."""


def dissipation(scene: Scene, *, ahead: bool = False) -> Any:
    """Dissipation time of contacts [s]; `ahead`: of those that act ahead of touch.

    MuJoCo's do not: one that is to end its step apart is gone in the next one, and what should rest
    hops, unless its dissipation takes longer than a step. A tall box on an incline hops with 6 ms
    at steps of 10 ms and rests with 15.
    """
    tau = scene.contact.dissipation_time
    least = 1.5 * scene.discretization.timestep
    return tau if ahead else tau + (least - tau) * (least > tau)


def contact_mass(scene: Scene, *, ahead: bool = False) -> Any:
    """D = k h (h + tau) of a contact of two bodies, see `laws.contact` [kg]."""
    h = scene.discretization.timestep
    return scene.contact.normal_stiffness * h * (h + dissipation(scene, ahead=ahead))


def friction_ratio(scene: Scene, ratio: Any, *, ahead: bool = False) -> Any:
    """MuJoCo's impratio D_t / D for a ratio of `[contact]`.

    A contact creeps by h / D_t per newton: for a ratio r that is 1 / (k r `CREEP`) at any step.
    """
    return ratio * CREEP / (scene.discretization.timestep + dissipation(scene, ahead=ahead))


def contact_invweight(scene: Scene) -> Any:
    """Inverse weight declared for every body in contact [1/kg].

    MuJoCo's R is (1 - d) / d times the sum of the bodies' inverse weights, for a constant impedance
    d. Declaring them instead of deriving them from masses makes D = 1/R a material number,
    independent of finger size. A contact with the table has one body and is twice as stiff.
    """
    return IMPEDANCE / ((1.0 - IMPEDANCE) * 2.0 * contact_mass(scene))


def palm_impedance(scene: Scene) -> Any:
    """Impedance at which contacts of fingers with the palm have a stiffness of their own."""
    stiffer = scene.contact.finger_palm_stiffness / scene.contact.normal_stiffness
    return 1.0 / (1.0 + (1.0 - IMPEDANCE) / (IMPEDANCE * stiffer))


def palm_touches(scene: Scene) -> bool:
    """Whether an effect calls for the palm's contact spheres."""
    return scene.effects.palm_object or scene.effects.palm_table


def touches_itself(scene: Scene) -> bool:
    """Whether fingers touch themselves; spheres do not."""
    return scene.effects.finger_itself and scene.effects.surface == "hull"


def sections_grow(scene: Scene) -> bool:
    """Whether contact surfaces of fingers grow with their pressure; spheres do not."""
    return scene.effects.section_growth and scene.effects.surface == "hull"


PALM_FROM = 0.25
"""Share of a finger's length from its base that is not tested against the palm, to which it is
fixed."""
PALM_HEIGHTS = 1.0
"""Heights of its section from its base that are not tested either: sections across a finger that
leaves the palm aslant reach into the disc as far along it as they are high."""


def first_on_palm(links: int) -> int:
    """The first link of a finger of any length that may touch the palm, see `beyond_base`.

    Link 0 is the half one at its base.
    """
    return math.ceil(PALM_FROM * links)


RING_TIP = 0.25
"""Length of the last link's segment, which ends in the tip's ring, in links."""


def ring_places(links: int, k: int) -> np.ndarray:
    """Places of the rings from their links' joints, in links, shape (link, k)."""
    places = np.tile((np.arange(k) + 0.5) / k, (links, 1))
    places[-1] *= 0.5
    places[-1, -1] = RING_TIP
    return places


def beyond_base(along: Any, height: Any) -> Any:
    """Whether a part of a finger is so far from its base that it may touch the palm.

    Args:
      along: Distance from the base along the finger [m], any shape.
      height: Height of the finger's section at its base [m], of a shape that broadcasts to it.
    """
    return along >= PALM_HEIGHTS * height


_PALM_RING = ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1))


def palm_points(scene: Scene, numpy: Any = jnp) -> Any:
    """Centres of the palm's contact spheres in the palm frame, whose origin is on the underside."""
    p = scene.hand.palm
    ring = numpy.asarray(p.contact_ring)
    up = numpy.asarray(p.contact_radius)
    return numpy.stack([numpy.stack([x * ring, y * ring, up]) for x, y in _PALM_RING])


def mount_points(hand: Hand, spread: Any, numpy: Any = jnp) -> tuple[Any, Any, Any]:
    """Base points (finger, 3) [m], azimuths and tilts (finger,) [rad] in the palm frame.

    Args:
      spread: Spread between the finger pairs [rad].
    """

    def each(name: str) -> Any:
        return numpy.stack([numpy.asarray(getattr(f, name)) for f in hand.finger])

    azimuth = numpy.deg2rad(each("azimuth")) + each("spread") * spread
    around = zip(numpy.cos(azimuth), numpy.sin(azimuth), strict=True)
    points = [f.base_point(c, s) for f, (c, s) in zip(hand.finger, around, strict=True)]
    x, y = (numpy.stack([numpy.asarray(p[i], azimuth.dtype) for p in points]) for i in (0, 1))
    position = numpy.stack([x, y, numpy.zeros_like(azimuth)], -1)
    return position, azimuth, numpy.deg2rad(each("tilt"))


def mounts(hand: Hand, spread: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Base position (finger, 3) and orientation (finger, 4) of the fingers in the palm frame."""
    position, azimuth, tilt = mount_points(hand, spread)
    # Rotation about z by the azimuth, then about y by the tilt: x leaves the palm outwards and
    # down.
    ca, sa, ct, st = (f(a / 2) for a in (azimuth, tilt) for f in (jnp.cos, jnp.sin))
    return position, jnp.stack([ca * ct, -sa * st, ca * st, sa * ct], -1)


def object_size(objects: ObjectSet, trial: Trial) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sizes of all shapes (shape, 3), and mass and principal inertia (3,) of the trial's."""
    shapes = objects.object
    full = jnp.stack([jnp.stack([jnp.asarray(v) for v in s.half_sizes]) for s in shapes])
    size = trial.size * full
    mass = trial.mass * jnp.stack([jnp.asarray(s.mass) for s in shapes])[trial.shape]
    unit = jnp.stack([_unit_inertia(s, size[i], trial.size) for i, s in enumerate(shapes)])
    return size, mass, mass * unit[trial.shape]


INACTIVE = 1e-3
"""Size of the geoms of a model's object that its trial does not use, over their own."""


def geom_sizes(size: Any, shape: Any, numpy: Any = jnp) -> Any:
    """Sizes (shape, 3) of the geoms of an object body, which carries one for each shape of the set.

    Those that a trial does not use are `INACTIVE`, deep inside the one in use, where nothing
    touches them.
    """
    used = np.arange(len(size)) == shape
    return numpy.where(used[:, None], size, INACTIVE * size)


def object_pose(objects: ObjectSet, trial: Trial) -> tuple[jax.Array, jax.Array]:
    """Height of the object's centre on the table [m] and its orientation (4,) at the start.

    It is upright, see `Shape.upright`, turned about x and y by the trial's tilt, then by its yaw.
    """
    quats = [jnp.array(shape.upright) for shape in objects.object]
    ups = [rigid_bodies.up(shape.upright) for shape in objects.object]
    if trial.tilt is not None:
        tilt = _after(_turn(trial.tilt[1], 2), _turn(trial.tilt[0], 1))
        quats = [_after(tilt, quat) for quat in quats]
        ups = [rigid_bodies.up(quat) for quat in quats]
    shapes = zip(objects.object, ups, strict=True)
    heights = jnp.stack([jnp.asarray(shape.rest_height(up)) for shape, up in shapes])
    quat = _after(_turn(trial.yaw, 3), jnp.stack(quats)[trial.shape])
    return trial.size * heights[trial.shape], quat


def _turn(angle: jax.Array, axis: int) -> jax.Array:
    half = jnp.asarray(angle) / 2  # of JAX's type, whatever NumPy's was
    return jnp.zeros(4, half.dtype).at[0].set(jnp.cos(half)).at[axis].set(jnp.sin(half))


def _after(second: jax.Array, first: jax.Array) -> jax.Array:
    a, b, c, d = second
    w, x, y, z = first
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def _unit_inertia(shape: Shape, size: jax.Array, factor: jax.Array) -> jax.Array:
    """Principal inertia per mass of a solid [m^2], shape (3,)."""
    if shape.mesh or shape.own_inertia:
        return jnp.array(shape.unit_inertia) * factor**2
    return jnp.stack(shape.primitive.inertia(size))


def geom_bounds(kind: str, size: Any, numpy: Any = jnp) -> tuple[Any, Any]:
    """Bounding radius () and axis-aligned half extents (3,) of a geom; a mesh's is a box."""
    shape = PRIMITIVES["box" if kind == "mesh" else kind]
    return shape.radius(size), numpy.stack(shape.half_extents(size))
