"""The record of each primitive against MuJoCo: compiler, distances, surface."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured.laws import rings, shapes
from codesign_jax.engines.structured.world_model import apply_columns
from codesign_jax.scene import primitives, rigid
from tests.helpers import grasps

# No two sizes of a shape are equal, so that none can stand for another.
SIZES = {
    "box": (0.030, 0.022, 0.041),
    "cylinder": (0.030, 0.036, 0.0),
    "capsule": (0.024, 0.020, 0.0),
    "sphere": (0.030, 0.0, 0.0),
}
KINDS = list(primitives.PRIMITIVES)


def on_table(kind):
    """MuJoCo's own model of a shape of 1 kg on a plane, in the record's start orientation."""
    shape, size = primitives.PRIMITIVES[kind], SIZES[kind]
    quat = " ".join(map(str, shape.upright))
    text = f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <body pos="0 0 {shape.reach(size, rigid.up(shape.upright))}" quat="{quat}"><freejoint/>
      <geom type="{kind}" size="{" ".join(map(str, size))}" mass="1"/></body>
    </worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


@pytest.mark.parametrize("kind", KINDS)
def test_inertia_and_bounds_are_those_of_mujocos_compiler(kind):
    compiled, shape, size = on_table(kind), primitives.PRIMITIVES[kind], SIZES[kind]
    # MuJoCo sorts principal moments by turning the frame; the set of them stays.
    np.testing.assert_allclose(
        np.sort(shape.inertia(size)), np.sort(compiled.body_inertia[1]), rtol=1e-12
    )
    assert shape.radius(size) == pytest.approx(compiled.geom_rbound[1], rel=1e-12)
    np.testing.assert_allclose(shape.half_extents(size), compiled.geom_aabb[1, 3:], rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_triangles_lie_on_the_surface_and_have_its_inertia(kind):
    """In the shape's own axes, with its volume; polyhedra in round shapes lack up to 0.5 %."""
    shape, size = primitives.PRIMITIVES[kind], SIZES[kind]
    mesh = shape.triangles(size)
    own = np.diag(mesh.moment_inertia) / mesh.volume
    np.testing.assert_allclose(shape.inertia(size), own, rtol=5e-3)
    np.testing.assert_allclose(mesh.bounds[1], shape.half_extents(size), rtol=2e-3)
    way = np.array([0.48, -0.6, 0.64])
    assert shape.reach(size, way) == pytest.approx((mesh.vertices @ way).max(), rel=2e-3)
    with jax.enable_x64(True):
        sizes, points = jnp.asarray(size)[:, None, None], jnp.asarray(mesh.vertices.T[:, None])
        distance, _ = shapes.SHAPES[kind].distance(sizes, points)
    assert np.abs(distance).max() < 1e-9  # trimesh rounds corners that it merges to 1e-8


# --- distances of finger spheres ------------------------------------------------------------------


RADIUS, POSES = 0.010, 1500


def poses():
    """Random object poses and sphere centres from deep inside to a hand's breadth away."""
    rng = np.random.default_rng(7)
    quat = rng.standard_normal((POSES, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    position = rng.uniform(-0.2, 0.2, (POSES, 3))
    # A third of the centres around the object's surface and edges, where regions meet.
    spread = np.where(np.arange(POSES) % 3 == 0, 0.05, 0.12)[:, None]
    return position, quat, position + rng.uniform(-spread, spread, (POSES, 3))


def reference(kind, position, quat, centre):
    """MuJoCo's distances and the normals from the object to the sphere where they are defined."""
    size = " ".join(map(str, SIZES[kind]))
    xml = f"""<mujoco><worldbody>
      <body mocap="true"><geom type="{kind}" size="{size}"/></body>
      <body mocap="true"><geom type="sphere" size="{RADIUS}"/></body>
    </worldbody></mujoco>"""
    data = mujoco.MjData(compiled := mujoco.MjModel.from_xml_string(xml))
    distance, normal, points = np.zeros(POSES), np.zeros((POSES, 3)), np.zeros(6)
    for i in range(POSES):
        data.mocap_pos[:] = position[i], centre[i]
        data.mocap_quat[0] = quat[i]
        mujoco.mj_kinematics(compiled, data)
        distance[i] = mujoco.mj_geomDistance(compiled, data, 0, 1, 1.0, points)
        away = (points[3:] - points[:3]) * np.sign(distance[i])
        normal[i] = away / max(np.linalg.norm(away), 1e-300)
    return distance, normal


def engine_contacts(kind, position, quat, centre):
    """The engine's contacts for the same poses, one sphere a world, in float64."""
    columns = np.zeros((POSES, 9))
    for i in range(POSES):
        mujoco.mju_quat2Mat(columns[i], quat[i])
    with jax.enable_x64(True):
        alone = grasps.pinch(kind)
        size = np.broadcast_to(np.array(SIZES[kind])[:, None, None], (3, 1, POSES))
        frames = jnp.asarray(columns.reshape(POSES, 3, 3).transpose(2, 1, 0)[:, :, None])
        at = jnp.asarray((centre - position).T[:, None])  # frames: column, row, 1, world
        local, shape = shapes.in_object(frames, at), jnp.zeros((1, POSES), jnp.int32)
        distance, gradient = shapes.primitive_distance(alone, jnp.asarray(size), shape, local)
        return rings.ball_on_field(RADIUS, at, distance, apply_columns(frames, gradient))


@pytest.mark.parametrize("kind", KINDS)
def test_distances_equal_mujoco(kind):
    """Distance and normal of spheres outside of an object, and the depth of those that overlap."""
    position, quat, centre = poses()
    want, normal = reference(kind, position, quat, centre)
    got = engine_contacts(kind, position, quat, centre)
    gap = np.asarray(got.gap)[0]
    outside, inside = gap > 1e-6, gap < -1e-6
    assert 0.2 < outside.mean() < 0.99 and inside.sum() > 100  # both kinds of poses are tried
    # Both are closed forms in float64; they differ by rounding of lengths below a metre.
    both = outside | inside
    np.testing.assert_allclose(gap[both], want[both], rtol=0, atol=1e-14)
    found = np.asarray(got.normal)[:, 0].T
    # The witness points give the direction; two of them wrong by rounding, a gap apart, turn it.
    angle = np.linalg.norm(found - normal, axis=1)
    near = outside & (gap > 1e-3)
    assert np.all(angle[near] < 1e-14 / gap[near])
    # Contact points lie half way between the surfaces.
    point = np.asarray(got.point)[:, 0].T
    back = centre - position - point
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), np.abs(RADIUS + gap / 2), atol=1e-12)
