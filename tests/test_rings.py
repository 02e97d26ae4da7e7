"""The hull in contact: rings against a dense skin, its mesh, depths, friction that is held."""

import functools
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from codesign_jax import model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import world_model
from codesign_jax.engines.structured.laws import holding, rings
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, constraint_update
from codesign_jax.model import held as friction_held
from codesign_jax.model import hull
from codesign_jax.scene import load, parameters
from codesign_jax.scene.schema import InputError
from scripts import contact_depths
from tests.helpers import dense_skin, grasps
from tests.helpers.dense_skin import turned
from tests.helpers.differences import curled

STIFFNESS = 4000.0
LENGTH = 0.11
WIDTH = 0.024
HEIGHT = 0.020
LINKS = 10
PER_AREA = STIFFNESS / WIDTH**2
DEPTHS = np.array([-0.5, 0.5, 1, 2, 3, 6]) * 1e-3
PLACES = 10


def ring_numbers(body):
    """The rings of a finger: numbers (8, ring) of `Ring.of` and the links they are on (ring,)."""
    numbers = _numbers(body.height, body.segment, body.width)
    return numbers, np.repeat(np.arange(LINKS), numbers.shape[1] // LINKS)


@functools.cache
def _numbers(height, segment, width):
    scene = load("paper")
    section = np.array([height, 0.0, segment, width])
    with jax.enable_x64(True):
        finger = SimpleNamespace(section=jnp.asarray(section), tip=None)
        return np.asarray(world_model.ring_numbers(scene, finger)).T


def ringed(bodies):
    """Rings and their frames and centres, with axes (ring, body) behind."""
    numbers = []
    frames = []
    centres = []
    for body in bodies:
        ring, link = ring_numbers(body)
        frame = body.frames[link + 1]
        numbers.append(ring)
        frames.append(frame)
        centres.append(body.joints[link] + np.einsum("rij,jr->ri", frame, ring[:3]))
    columns = np.stack(frames).transpose(3, 2, 1, 0)
    return np.stack(numbers, -1), columns, np.stack(centres).transpose(2, 1, 0)


@functools.cache
def laws():
    """`rings.aim`, `rings.on_field` and the nearest `rings.between`, compiled."""

    @jax.jit
    def aim(numbers, frame, distance, gradient):
        return rings.aim(rings.Ring.of(numbers), frame, distance, gradient)

    @jax.jit
    def on_field(numbers, frame, centre, offset, distance, normal):
        ring = rings.Ring.of(numbers)
        return rings.on_field(ring, frame, centre, offset, distance, normal)

    @jax.jit
    def between(numbers, frame, centre, ends, frames, half):
        """Axes behind: (ring, body); of the segments (segment, body)."""

        def each(ring, frame, centre, ends, frames, half):
            segment = rings.Segment(tuple(ends), tuple(frames), half)
            t = rings.nearest(centre, segment)
            apart = ((centre - rings.on_line(segment, t)) ** 2).sum()
            return apart, rings.between(rings.Ring.of(ring), frame, centre, segment, t)

        def nearest(ring, frame, centre, ends, frames, half):
            many = jax.vmap(each, (None, None, None, -1, -1, -1))
            apart, results = many(ring, frame, centre, ends, frames, half)
            return jax.tree.map(lambda v: v[apart.argmin()], results)

        every = jax.vmap(nearest, (-1, -1, -1, None, None, None))
        return jax.vmap(every, -1)(numbers, frame, centre, ends, frames, half)

    return aim, on_field, between


def pushes(place):
    """Force and moment about the origin, each (body, 3), from places with axes (3, ring, body)."""
    size = STIFFNESS * np.asarray(place.share) * np.maximum(-np.asarray(place.gap), 0)
    force = size * np.asarray(place.normal)
    moment = np.cross(np.asarray(place.point), force, axis=0)
    return force.sum(1).T, moment.sum(1).T


def on_fields(bodies, fields):
    """What the law makes of fingers on fields."""
    aim, on_field, _ = laws()

    def seen(points):
        pairs = [f(points[..., i].T) for i, f in enumerate(fields)]
        return np.stack([d for d, _ in pairs], -1), np.stack([n.T for _, n in pairs], -1)

    with jax.enable_x64(True):
        numbers, frame, centre = ringed(bodies)
        offset = np.asarray(aim(numbers, frame, *seen(centre)))
        return pushes(on_field(numbers, frame, centre, offset, *seen(centre + offset)))


def segments(bodies):
    """Ends (2, 3, segment, body), frames (3, 3, 3, ...) and half axes of centre lines."""
    centre_lines = []
    for body in bodies:
        numbers, _ = ring_numbers(body)
        turn = body.frames
        tip, a, b = body.half
        up = b * np.concatenate([turn[:1, :, 2], (turn[:-1, :, 2] + turn[1:, :, 2]) / 2])
        end = body.joints[-1] + turn[-1] @ numbers[:3, -1]
        line = np.concatenate([np.concatenate([[body.base], body.joints]) + up, [end]])
        row = np.arange(LINKS + 1)
        frames = [turn[np.clip(row + k, 0, LINKS)] for k in (-1, 0, 1)]
        half = np.array([[tip * (k == LINKS), a, b] for k in row])
        columns = np.stack(frames).transpose(0, 3, 2, 1)
        centre_lines.append((np.stack([line[:-1], line[1:]]).transpose(0, 2, 1), columns, half.T))
    return tuple(np.stack(v, -1) for v in zip(*centre_lines, strict=True))


def on_fingers(bodies, others):
    """What the law makes of pairs of fingers: the pushes on the first of each."""
    between = laws()[2]
    with jax.enable_x64(True):
        return pushes(_sorted(between(*ringed(bodies), *segments(others))))


def _sorted(place):
    """Axes (body, ring, 3) to (3, ring, body)."""
    return jax.tree.map(lambda v: jnp.asarray(v).T, place)


# Cases: from a place in [0, 1) and a depth to a finger, and a field or another finger.  They touch
# at the origin, so that the reference is the same at every place.


def straight(place, length=LENGTH, turn=dense_skin.UPRIGHT):
    """A finger with its bottom at the origin, within three links of its middle."""
    return dense_skin.finger(length, base=-turn[:, 0] * length * (0.35 + 0.31 * place), turn=turn)


def flat(place, depth):
    """The whole of a finger, of another length at each place."""
    up = np.array([0, 0, 1.0])
    return dense_skin.finger(0.08 + 0.08 * place), dense_skin.half_space(depth * up, up)


def arc(place, links=LINKS):
    """A finger wound about a cylinder with a radius of 32.5 mm, of another size at each place."""
    length = 0.08 + 0.08 * place
    height = 0.015 + 0.01 * ((place * 7) % 1)
    bend = 2 * np.arctan(length / links / 2 / 0.0325)
    return dense_skin.finger(length, height=height, bend=bend, links=links)


def wrapped(place, depth):
    axis = np.array([0, 1.0, 0])
    return arc(place), dense_skin.cylinder(np.array([0, 0, -0.0325]), axis, 0.0325 + depth)


def edge_across(place, depth):
    half = np.array([0.03, 0.05, 0.03])
    centre = np.array([0, 0, depth - np.sqrt(2) * half[0]])
    return straight(place), dense_skin.box(centre, turned([0, 1, 0], np.pi / 4), half)


def corner(place, depth):
    z = np.ones(3) / np.sqrt(3)
    x = np.array([1, -1, 0]) / np.sqrt(2)
    turn = np.stack([x, np.cross(z, x), z])
    return straight(place), dense_skin.box(
        np.array([0, 0, depth - np.sqrt(3) * 0.03]), turn, np.full(3, 0.03)
    )


def sphere(place, depth):
    return straight(place), dense_skin.ball(np.array([0, 0, depth - 0.03]), 0.03)


def crossed(place, depth):
    other = straight((7 * place + 0.3) % 1, turn=turned([0, 0, 1], np.pi / 2))
    return straight(place), other._replace(joints=other.joints + [0, 0, HEIGHT - depth])


def tip_on_side(place, depth):
    """A tip on the upper side, from straight above."""
    other = dense_skin.finger(LENGTH, turn=turned([0, 1, 0], np.pi / 2))
    move = np.array([0, 0, HEIGHT + LENGTH - depth])
    move[0] = -HEIGHT / 2
    return straight(place), other._replace(joints=other.joints + move)


WHOLE = ("flat", "wrapped")
"""Cases in which all of a finger touches."""
FIELDS = {
    "flat": flat,
    "wrapped": wrapped,
    "sphere": sphere,
    "edge across": edge_across,
    "corner": corner,
}
FINGERS = {"crossed at 90 degrees": crossed, "tip on a side": tip_on_side}

# Force over the reference's at each of `DEPTHS` from 0.5 mm on, least and most over the places; the
# largest angle between both [degrees] and distance of their lines of action [mm] from 1 mm on.
# Within 20 % where a surface lies on a smooth one, within 30 % between fingers.  What is wider:
# * Below 1 mm two fingers have the stiffness of 1 mm, `NOMINAL` of each, which lets them begin.
# * A ring takes what it touches as a plane across its whole section.  On a ball and an edge, which
#   touch a part of it, it pushes too hard; less as it sinks in.  A skin on a sharp edge is no truth
#   either: a solid of rubber pushes ten times as hard as its skin.
# * A tip's end is flat for the law, whose area is reached at once, and round for the skin.  The
#   normal at a tip is not that of the least overlap: it acts up to 1 mm ahead of touch.
SMOOTH = (0.8, 1.2)
PAIRED = (0.7, 1.3)
EXPECTED = {
    "flat": ([SMOOTH] * 5, 1, 1),
    "wrapped": ([SMOOTH] * 5, 6, 3),
    "sphere": ([(2.3, 2.8), (1.9, 2.2), (1.6, 1.9), (1.5, 1.8), (1.4, 1.6)], 1, 0.5),
    "edge across": ([(4, 30), (9, 14), (6, 8), (4, 6), (2, 3)], 13, 1.5),
    "corner": ([(150, 1200), (200, 320), (80, 110), (40, 58), (14, 20)], 14, 1.5),
    "crossed at 90 degrees": ([(1.2, 1.8), *[PAIRED] * 4], 1, 1),
    "tip on a side": ([(2.8, 3.5), (1.7, 2.1), (1.3, 1.6), *[PAIRED] * 2], 3, 1.5),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_ring_pushes_as_a_skin(name):
    """Forces, lines of action, and that neither edge nor corner is missed between two rings."""
    bounds, angle, apart = EXPECTED[name]
    ratio, off, away, force = compared(name)
    for k, (low, high) in enumerate(bounds, 1):
        assert (ratio[:, k] >= low).all() and (ratio[:, k] <= high).all(), (DEPTHS[k], ratio[:, k])
    assert np.degrees(off[:, 2:]).max() < angle and 1e3 * away[:, 2:].max() < apart
    assert (force[:, 0] == 0).all() or name.startswith("tip")  # nothing ahead of touch
    assert (force[:, 2:] > 0.4).all()  # seen at 1 mm, wherever it is
    ripple = force[:, 2:].std(0) / force[:, 2:].mean(0)
    assert name in WHOLE or (ripple < 0.2).all(), ripple  # whole fingers differ in size


def compared(name):
    """Forces over the reference's, angles [rad], ways [m] between, forces [N]: (place, depth)."""
    case = FIELDS.get(name) or FINGERS[name]
    grid = [(p, d) for p in (np.arange(PLACES) + 0.5) / PLACES for d in DEPTHS]
    pairs = [case(p, d) for p, d in grid]
    bodies, others = zip(*pairs, strict=True)
    only = pairs if name in WHOLE else pairs[: len(DEPTHS)]
    if name in FIELDS:
        references = [_reference(name, *pair, p) for pair, (p, _) in zip(only, grid, strict=False)]
        force, moment = on_fields(bodies, others)
    else:
        references = [dense_skin.on_finger(b, o, PER_AREA) for b, o in only]
        force, moment = on_fingers(bodies, others)
    want, turn = (np.array([w[i] for w in references]).reshape(-1, len(DEPTHS), 3) for i in (0, 1))
    force, moment = (v.reshape(PLACES, len(DEPTHS), 3) for v in (force, moment))
    size, full = (np.linalg.norm(v, axis=-1) for v in (force, want))
    cosine = (force * want).sum(-1) / np.maximum(size * full, 1e-12)
    # The point nearest to the origin of each line of action.
    mine, theirs = (
        np.cross(f, m) / np.maximum((f**2).sum(-1), 1e-12)[..., None]
        for f, m in ((force, moment), (want, turn))
    )
    angle = np.arccos(np.clip(cosine, -1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = size / full
    return ratio, angle, np.linalg.norm(mine - theirs, axis=-1), size


def _reference(name, body, field, place):
    """All of a finger beyond the half segment at its base, or pieces of 0.2 mm about the origin.

    The wound finger is round there: corners of its chain at the joints, 0.5 mm high, are no skin.
    """
    low = body.segment / 2
    if name in WHOLE:
        body = arc(place, 80) if name == "wrapped" else body
        return dense_skin.on_field(body, field, PER_AREA, low=low)
    middle = -body.base @ body.frames[0][:, 0]
    window = {"low": middle - 0.025, "high": middle + 0.025}
    return dense_skin.on_field(body, field, PER_AREA, **window, along=250, around=400)


@pytest.mark.parametrize(("dtype", "few"), [(np.float32, 1e-6), (np.float64, 1e-9)])
def test_roots_are_powers(dtype, few):
    """Their derivative too, to the steps' precision: eight rounding errors in float32."""
    x = np.geomspace(1e-9, 10, 1000).astype(dtype)
    for root, power in ((rings.cube_root, 1 / 3), (rings.inverse_cube_root, -1 / 3)):
        with jax.enable_x64(dtype == np.float64):
            y, slope = jax.jvp(root, (jnp.asarray(x),), (jnp.ones_like(x),))
        assert y.dtype == dtype
        exact = x.astype(np.float64) ** power
        np.testing.assert_allclose(y, exact, rtol=few)
        np.testing.assert_allclose(slope, power * exact / x, rtol=few)


@pytest.mark.slow  # 9 s
def test_hands_grasp_whose_fingers_are_no_power_of_two():
    """Lanes that pad three fingers to four hold no finger: what they calculate is a number too."""
    names = "disturb ungrasp twist lateral_bending palm_object palm_table finger_table finger_palm"
    off = dict.fromkeys((*names.split(), "finger_finger", "finger_itself"), False)
    ends = {"approach": 0.5, "inflate": 1.0, "lift": 1.2}
    overrides = {"discretization": {"links": 2}, "effects": off, "phases": ends}
    # A low hand with soft walls, which the default pressures close.
    overrides |= {"arm.zero_height": 0.005, "hand.material.law": "linear"}
    overrides |= {"hand.material.shear_modulus": 40e3}
    the_scene = load("paper", hand_name="tripod3", overrides=overrides)
    space = parameters.design_space(the_scene.hand)
    params = space.params(space.default())
    trial = rollout.nominal_trial(the_scene, "sphere")
    worlds = jax.tree.map(lambda v: jnp.asarray(v)[None], (params, trial))
    engine = make_engine("structured", the_scene)
    outcome, trace = jax.jit(lambda p, t: rollout.simulate(the_scene, engine, p, t))(*worlds)
    assert outcome.status[0] == 0 and outcome.cost[0] == 0
    assert float(trace.height[0, -1]) > 0.1, "lifted"


# --- the hull's mesh: closed, as large as the finger, skinned as MuJoCo's renderer skins it -------


def hull_scene(links=4, rings=2, points=8):
    density = {"discretization__hull_rings": rings, "discretization__hull_points": points}
    return grasps.pinch("box", links=links, effects__surface="hull", **density)


@pytest.mark.parametrize(("links", "rings", "points"), [(1, 1, 4), (4, 2, 8), (3, 5, 20)])
def test_mesh_is_the_closed_block_of_the_finger(links, rings, points):
    """Watertight, faces outwards, with the block's volume; trimesh measures it."""
    the_scene = hull_scene(links, rings, points)
    mesh = hull.hull(the_scene, square=True)
    width = the_scene.hand.section.width
    straight = hull.rest(the_scene, LENGTH, HEIGHT, square=True)
    body = trimesh.Trimesh(straight, mesh.face, process=False)
    assert body.is_watertight and body.is_winding_consistent
    np.testing.assert_allclose(body.volume, LENGTH * width * HEIGHT, rtol=1e-12)
    np.testing.assert_allclose(mesh.weight.sum(1), 1.0, atol=1e-12)
    assert (mesh.weight >= -1e-12).all()


def test_what_is_drawn_is_the_section_that_touches():
    """|y/a|^4 + |z/b|^4 = 1 has the area 0.9270 of its square; the cap is a quarter of a link."""
    the_scene = hull_scene(links=4, rings=8, points=80)
    straight = hull.rest(the_scene, LENGTH, HEIGHT)
    body = trimesh.Trimesh(straight, hull.hull(the_scene).face, process=False)
    width = the_scene.hand.section.width
    cap = LENGTH / 16
    # Half of |x|^4 + |y|^4 + |z|^4 <= 1 has the volume 4 gamma(5/4)^3 / gamma(7/4).
    volume = (LENGTH - cap + cap * 0.8106 / 0.9270) * 0.9270 * width * HEIGHT
    assert body.is_watertight
    np.testing.assert_allclose(body.volume, volume, rtol=0.01)


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="hull_points = 6 must be a multiple of 4"):
        hull_scene(points=6)
    with pytest.raises(InputError, match="did you mean 'hull'"):
        scene.load("paper_spheres", overrides={"effects": {"surface": "hul"}})


# --- depths that `scripts.contact_depths` tells, of poses whose depth is known --------------------


def tube(body, height=0.0):
    """A finger of one state, moved up."""
    joints = body.joints + [0, 0, height]
    size = body.length, body.width, body.height
    return contact_depths.tube(joints[None], body.frames[None], size)


@pytest.mark.parametrize("depth", [-1e-3, 0.5e-3, 3e-3, 8e-3])
@pytest.mark.parametrize("angle", [0, 30, 90])
def test_a_finger_is_as_deep_in_another_one_as_it_was_moved(angle, depth):
    """Across, along, and a tip that comes from above, whose end is nearer than its sides."""
    turn = turned([0, 0, 1], np.radians(angle))
    across = dense_skin.finger(LENGTH, base=[0.055, 0, 0] - turn[:, 0] * 0.055, turn=turn)
    down = turned([0, 1, 0], np.pi / 2)
    above = dense_skin.finger(LENGTH, base=[0.045, 0, LENGTH], turn=down)
    straight_tube = tube(dense_skin.finger(LENGTH))
    for other in (tube(across, HEIGHT - depth), tube(above, HEIGHT - depth)):
        for a, b in ((straight_tube, other), (other, straight_tube)):
            depths = contact_depths.in_tube(a.rings, b)
            np.testing.assert_allclose(depths, [max(depth, 0)], atol=0.05e-3)


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_an_edge_of_an_object_is_in_a_finger(kind):
    """An object that stands with an edge in a finger; and a finger in its face."""
    shape = type("Shape", (), {"type": kind})
    size = np.array([0.03, 0.03, 0.03])
    depth = 2e-3
    edges, skin = contact_depths.surface(shape, size)
    straight_tube = tube(dense_skin.finger(LENGTH))
    inclined = turned([0, 1, 0], np.pi / 4)
    low = (edges @ inclined.T)[:, 2].min()
    at = np.array([0.0567, 0, HEIGHT - depth - low])
    assert (skin @ inclined.T)[:, 2].min() > low - 1e-9
    depths = contact_depths.in_tube((edges @ inclined.T + at)[None, :, None], straight_tube)
    np.testing.assert_allclose(depths, depth, atol=0.1e-3)
    away = straight_tube.rings.reshape(1, -1, 3) - [0.055, 0, HEIGHT - depth + size[2]]
    np.testing.assert_allclose(contact_depths.in_object(kind, size, away), depth, atol=1e-6)


# --- friction that fingers hold from step to step: its law on contacts alone, and who has it ------


MU = 0.8
STEPS = 8


def test_sliding_bodies_hold_coulomb_s_coefficient():
    """Contacts of one normal that slide and close: |g| is mu, against the motion."""

    @jax.jit
    def grip_of(share):
        cone = Cone(1.44 * share, 1.44 * share, MU, MU, 2778.0, 111.0)
        normals = jnp.array([[0.0], [0.0], [1.0]]) * jnp.ones((1, 3))
        contacts = Contacts(0 * normals, normals, -jnp.array([1e-3, 3e-3, 2e-4]), cone)
        velocity = jnp.array([[2.0], [0.0], [-0.1]]) * jnp.ones((1, 3))
        jar = -contacts.reference(velocity)
        none = jnp.zeros((3, 3))
        force = constraint_update(contacts, jar + holding.held(contacts, none)).force
        return holding.quotient(holding.hold(contacts, force, none).sum(1))

    with jax.enable_x64(True):
        grip = np.asarray(grip_of(np.array([0.3, 1.0, 0.6])))
    assert grip[0] > 0 and np.hypot(*grip[:2]) == pytest.approx(MU, rel=1e-12)


SHARES = 0.90, 0.98, 1.00, 1.02, 1.10
"""Friction coefficients over the one at which a load just slips."""
LOAD = 0.44
PRESS = 12.0
WEIGHT = 0.045
"""Load along a pad and force on it [N], and the mass that hangs there [kg]."""


def hanging(pads):
    """Ways [m] that a mass on pads goes in 5 s, step by step (step, share): it slips down them.

    It is pressed on each pad, and its motion across them is given: the law of one contact alone.
    """
    h = 0.01
    tau = 0.006
    stiffness = 4000.0
    ratio = 5.0
    none = jnp.zeros((3, pads, len(SHARES)))
    friction = jnp.array(SHARES) * LOAD / (PRESS * pads)
    normal = stiffness * h * (h + tau)
    tangent = stiffness * h * ratio * 0.04
    damper = 1 / h + none[0]
    cone = Cone(
        normal + none[0],
        tangent + none[0],
        friction + none[0],
        friction * np.sqrt(normal / tangent) + none[0],
        1 / (h * (h + tau)) + none[0],
        damper,
    )
    inward = (-1.0) ** jnp.arange(pads)[:, None] + none[0]
    normals = jnp.stack([inward, none[0], none[0]])
    contacts = Contacts(none, normals, -PRESS / stiffness + none[0], cone)

    def pushed(acc, velocity, grip):
        down = jnp.array([0.0, 0.0, -1.0])[:, None, None]
        jar = acc * down - contacts.reference(velocity * down) + holding.held(contacts, grip)
        return constraint_update(contacts, jar).force

    def step(state, _):
        velocity, way, grip = state

        def halve(_, ends):
            low, high = ends
            acc = 0.5 * (low + high)
            above = WEIGHT * acc - LOAD - -pushed(acc, velocity, grip)[2].sum(0) > 0
            return jnp.where(above, low, acc), jnp.where(above, acc, high)

        far = 1e4 + 0 * velocity
        acc = sum(jax.lax.fori_loop(0, 60, halve, (-far, far))) / 2
        force = pushed(acc, velocity, grip)
        grip = holding.quotient(holding.hold(contacts, force, grip))
        velocity = velocity + h * acc
        return (velocity, way + h * velocity, grip), way + h * velocity

    still = jnp.zeros(len(SHARES))
    return jax.jit(lambda: jax.lax.scan(step, (still, still, none), None, length=500)[1])()


@pytest.mark.parametrize("pads", [1, 2, 3])
def test_a_load_slips_below_the_critical_friction_and_holds_above(pads):
    """Above, all that it goes is once the tangential spring's way, h^2 LOAD / D_t, 5.5 um.

    Below it slips on and on.  How fast is the cone's: MuJoCo's couples slip to the normal force, so
    that what is pressed by bodies that do not give way slides as in oil.
    """
    with jax.enable_x64(True):
        ways = np.asarray(hanging(pads))
    for share, way in zip(SHARES, ways.T, strict=True):
        print(share, way[-1], way[-1] - way[99])
        if share < 1:
            assert way[-1] - way[99] > 0.05
        if share > 1:
            assert way[-1] < 6e-6 and abs(way[-1] - way[99]) < 1e-9


def test_spheres_keep_nothing():
    """Their contact is that of MuJoCo, which has no state, so that every engine simulates it."""
    for surface, remembers in ("hull", True), ("spheres", False):
        chosen = scene.load("paper", overrides={"effects.surface": surface})
        assert chosen.effects.friction_memory and bool(friction_held.held(chosen)) == remembers
    make_engine("mujoco", chosen)


@pytest.mark.slow  # 10 s; quick: a policy's periods (test_policy), what is held (planted faults)
def test_a_rollout_in_pieces_is_that_of_one_piece():
    """Of two fingers that close on one another and on the object: equal bits.

    What fingers hold, the solver's warm start and the time of the grasp pass on.
    """
    off = "finger_table palm_object palm_table finger_palm finger_itself twist"
    overrides = {"effects__finger_finger": True, "effects__friction_memory": True}
    overrides |= grasps.off(off) | {"effects__surface": "hull"}
    chosen = grasps.pinch("box", links=2, **overrides)
    engine = make_engine("structured", chosen)

    def advance(start, ctrl):
        trace = engine.rollout(fields._replace(start=start), ctrl)
        return trace.last, (trace.distance, trace.height, trace.speed)

    def pieces(start, ctrl, size):
        parts = jnp.moveaxis(ctrl.reshape(1, -1, size, ctrl.shape[2]), 1, 0)
        last, shown = jax.lax.scan(advance, start, parts)
        return last, jnp.stack(shown).reshape(3, -1)

    with jax.enable_x64(True):
        begin = curled(chosen, STEPS, bend=0.8, height=0.12)
        fields, ctrl = jax.tree.map(lambda v: jnp.asarray(v)[None], (begin.fields, begin.ctrl))
        ctrl = ctrl.at[..., 6:].set(180e3)  # Pa: they press on one another
        start = jnp.concatenate(model.split(chosen, fields.start), -1)
        series = [jax.jit(partial(pieces, size=size))(start, ctrl) for size in (STEPS, 1)]
    jax.tree.map(np.testing.assert_array_equal, *series)
    hold = np.asarray(model.split(chosen, series[0][0]).held).reshape(-1, 2)
    rows = friction_held.rows(chosen)
    assert set(rows) == {"finger_finger", "finger_object", "object_table"}
    assert min(np.abs(hold[part]).max() for part in rows.values()) > 0.05
