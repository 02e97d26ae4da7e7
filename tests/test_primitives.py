"""The record of each primitive against MuJoCo's compiler, its own distance and its surface."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured.laws import shapes
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


def test_every_primitive_is_tried():
    assert set(SIZES) == set(KINDS) == set(grasps.SHAPES)


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
def test_inertia_is_in_the_shapes_own_axes(kind):
    """Of the triangles' solid about each axis; polyhedra inside round shapes lack up to 0.5 %."""
    shape, size = primitives.PRIMITIVES[kind], SIZES[kind]
    mesh = shape.triangles(size)
    own = np.diag(mesh.moment_inertia) / mesh.volume
    np.testing.assert_allclose(shape.inertia(size), own, rtol=5e-3)
    np.testing.assert_allclose(mesh.bounds[1], shape.half_extents(size), rtol=2e-3)
    way = np.array([0.48, -0.6, 0.64])
    assert shape.reach(size, way) == pytest.approx((mesh.vertices @ way).max(), rel=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_shape_rests_on_the_table_and_stays(kind):
    """It touches the plane to rounding at its start, and has not turned after a second."""
    compiled = on_table(kind)
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    assert np.abs(data.contact.dist).min() < 1e-12
    mujoco.mj_step(compiled, data, 500)
    # MuJoCo's contacts sink in by less than a micrometre a newton; nothing turns or falls.
    np.testing.assert_allclose(data.qpos[3:], primitives.PRIMITIVES[kind].upright, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_outline_and_triangles_lie_on_the_surface(kind):
    shape, size = primitives.PRIMITIVES[kind], SIZES[kind]
    points = np.concatenate([*shape.outline(size), shape.triangles(size).vertices])
    with jax.enable_x64(True):
        sizes = jnp.asarray(size)[:, None, None]
        distance, _ = shapes.SHAPES[kind].distance(sizes, jnp.asarray(points.T[:, None]))
    assert np.abs(distance).max() < 1e-9  # trimesh rounds corners that it merges to 1e-8


@pytest.mark.parametrize("names", [KINDS[1:], [*KINDS, "cone"]])
def test_a_shape_without_record_or_distance_is_refused_at_import(names):
    with pytest.raises(TypeError, match=KINDS[0] if len(names) < len(KINDS) else "cone"):
        primitives.check("distances", names)
