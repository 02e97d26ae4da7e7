"""The force between two straight hulls against the volume in which their sections overlap."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax.engines.structured.kernel import skin
from codesign_jax.engines.structured.laws import sections
from codesign_jax.scene import load

WIDTH, HEIGHT, LINKS = 0.024, 0.020, 10
HALF = np.array([WIDTH, HEIGHT]) / 2


@functools.cache
def added(rings):
    """What points of a row add to the sums of another row, all at once, and a finger's points."""
    density = {"discretization": {"hull_rings": rings}}
    the_scene = load("paper", overrides=density)
    count = skin.pair_points(the_scene)

    def one(point, joint, frame, there, turned, size, last):
        own, theirs = (joint[:, None], frame, frame), (there[:, None], turned, turned)
        none = jnp.zeros((sections.SUMS, 1))
        found = sections.inside(point[:, None], own, theirs, size, last[None])
        return sections.add_vertex(none, *found)[4, 0]

    many = jax.vmap(one, (0, None, None, None, None, None, None))  # points of a row
    many = jax.vmap(many, (0, 0, None, None, None, None, None))  # rows
    many = jax.vmap(many, (None, None, None, 0, None, None, 0))  # rows of the other finger
    sums = jax.jit(lambda *args: many(*args).sum())

    def points(length):
        section = jnp.array([HEIGHT, 0.004, length / LINKS, WIDTH])[:, None, None]
        found = np.asarray(skin.pair_vertices(the_scene, section))[..., 0, 0]
        return found.reshape(skin.KINDS, count, -1)

    return sums, points


def force(rings, length, roll, angle, depth, offset):
    """Sum of share x depth along the axis between two fingers [m], of all pairs of rows."""
    sums, points = added(rings)
    segment, size = length / LINKS, jnp.array([*HALF, length / LINKS / 2])[:, None]
    total, fingers = 0.0, placed(length, roll, angle, depth, offset)
    kinds = np.maximum(np.arange(LINKS + 1) - LINKS + 2, 0)
    middles = (np.minimum(np.arange(LINKS + 1), LINKS - 1) + 0.5) * segment
    last = (np.arange(LINKS) == LINKS - 1).astype(float)
    for sign, pair in ((1, fingers), (-1, fingers[::-1])):
        joints = [base + np.outer(middles, frame[:, 0]) for frame, base in pair]
        turns = [frame.T[..., None] for frame, _ in pair]
        args = joints[0], turns[0], joints[1][:-1], turns[1], size, last
        total -= sign * float(sums(points(length)[kinds], *args))
    return total


def placed(length, roll, angle, depth, offset):
    """Frames and bases of a finger that is rolled, and of one across it that is pressed on it."""
    c, s = np.cos(roll), np.sin(roll)
    first = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = np.cos(angle), np.sin(angle)
    second = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turn = np.linspace(0, 2 * np.pi, 4001)
    edge = np.stack([np.cos(turn), np.sin(turn)], 1) * HALF
    edge /= ((edge / HALF) ** 4).sum(1, keepdims=True) ** 0.25
    top = (edge @ first[1:, 1:].T)[:, 1].max()
    middle = np.array([0, 0, top + HALF[1] - depth])
    bases = [
        x - frame[:, 0] * length * (0.5 + o) - frame[:, 2] * HALF[1]
        for x, frame, o in zip((0, middle), (first, second), offset, strict=True)
    ]
    return list(zip((first, second), bases, strict=True))


def volume(roll, angle, depth, cell=1e-4):
    """Of the overlap of the two sections' prisms [m^3], by counting cells."""
    fingers = placed(1.0, roll, angle, depth, (0, 0))
    x = np.arange(-0.03, 0.03, 2 * cell) + cell
    top = fingers[1][1][2]
    heights = np.arange(top, top + depth, cell) + cell / 2
    grid, count = np.meshgrid(x, x, indexing="ij"), 0
    for z in heights:
        place, inside = np.stack([*grid, 0 * grid[0] + z], -1), True
        for frame, base in fingers:
            local = (place - base) @ frame
            section = (local[..., 1] / HALF[0]) ** 4 + (local[..., 2] / HALF[1] - 1) ** 4
            inside = inside & (section < 1)
        count += inside.sum()
    return count * 4 * cell**3


@pytest.mark.parametrize("angle", [90, 40])
def test_crossed_fingers_are_pushed_by_their_overlap(angle):
    """k/w^2 times the volume: the mean over where rings stand, within a tenth, at 0.5 and 1 mm."""
    angle, random = np.radians(angle), np.random.default_rng(0)
    offsets = 0.04 * random.random((8, 2))
    with jax.enable_x64(True):
        for depth in (0.5e-3, 1e-3):
            wanted = volume(0.0, angle, depth) / WIDTH**2
            found = [force(2, 0.11, 0.0, angle, depth, o) for o in offsets]
            assert abs(np.mean(found) / wanted - 1) < 0.1
            assert np.std(found) < 0.1 * wanted


@pytest.mark.parametrize("roll", [0, 45])
def test_the_force_grows_up_to_half_a_section(roll):
    """Flat on flat and an edge on a flat face, and it converges with the rings."""
    with jax.enable_x64(True):
        depths = np.arange(0.5, 10.1, 0.5) * 1e-3
        pushes = [force(2, 0.11, np.radians(roll), np.pi / 2, d, (0.02, 0.03)) for d in depths]
        assert (np.diff(pushes) > 0).all()
        fine = [force(n, 0.11, 0.0, np.pi / 2, 1e-3, (0.02, 0.03)) for n in (6, 12)]
        coarse = force(2, 0.11, 0.0, np.pi / 2, 1e-3, (0.02, 0.03))
        assert abs(fine[0] - fine[1]) < 0.2 * abs(coarse - fine[1])


def random_rows(rng, count):
    """Two rows of bent fingers near one another each: joint, frame before and frame behind it."""

    def frames(n):
        q = rng.normal(size=(n, 4))
        w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
        first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        second = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
        third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        return np.array([first, second, third])

    def bent(frame):
        angle = rng.uniform(-0.6, 0.6, count)
        turned = frame.copy()
        turned[0] = np.cos(angle) * frame[0] + np.sin(angle) * frame[2]
        turned[2] = np.cos(angle) * frame[2] - np.sin(angle) * frame[0]
        return turned

    rows = []
    for _ in range(2):
        before = frames(count)
        rows.append((rng.normal(size=(3, count)) * 0.008, before, bent(before)))
    return rows


@pytest.mark.parametrize("fault", [0.0, 3e-3])
def test_no_point_inside_a_row_is_left_out(fault):
    """Points that `inside` finds are never `outside`, nor are their rings; a planted shift shows.

    Random rows of bent fingers, 4,096 pairs with all points of a row; in float32, as in a kernel.
    """
    count, length = 4096, 0.14
    rng = np.random.default_rng(5)
    own, theirs = (tuple(map(jnp.float32, row)) for row in random_rows(rng, count))
    last = jnp.float32(rng.random(count) < 0.3)
    size = jnp.float32(np.repeat([[*HALF, length / LINKS / 2]], count, 0).T)
    points = jnp.float32(added(2)[1](length))[rng.integers(0, skin.KINDS, count)]
    points = jnp.moveaxis(points, 0, -1).reshape(2, -1, 8, count)  # ring, point, number, pair

    def ring(points):
        map_ = sections.ring_in_section(points[0], own, theirs).at[:, 0].add(fault)
        left = jax.vmap(lambda v: sections.outside(v, map_, size))(points)
        found = jax.vmap(lambda v: sections.inside(v, own, theirs, size, last)[0][2] < 0)(points)
        return sections.ring_outside(map_, size, size)[None], left, found[:, 0, 0]

    look = jax.jit(jax.vmap(ring))
    rings, left, found = (np.asarray(x) for x in look(points))
    assert 0.02 < found.mean() < 0.5 and left.mean() > 0.4, (found.mean(), left.mean())
    missed = (found & left).sum() + (found & rings).sum()
    assert bool(missed) == bool(fault), missed
    assert (left | ~rings).all() or fault  # a ring is left out only if each of its points is
