"""The hull's mesh: closed, as large as the finger, skinned as MuJoCo's renderer skins it."""

import numpy as np
import pytest
import trimesh

from codesign_jax import scene
from codesign_jax.model import hull
from codesign_jax.scene.schema import InputError
from tests.helpers import grasps

LENGTH, HEIGHT = 0.11, 0.018


def hull_scene(links=4, rings=2, points=8):
    density = {"discretization__hull_rings": rings, "discretization__hull_points": points}
    return grasps.pinch("box", links=links, effects__surface="hull", **density)


@pytest.mark.parametrize(("links", "rings", "points"), [(1, 1, 4), (4, 2, 8), (3, 5, 20)])
def test_mesh_is_the_closed_block_of_the_finger(links, rings, points):
    """Watertight, faces outwards, with the block's volume; trimesh measures it."""
    the_scene = hull_scene(links, rings, points)
    mesh, width = hull.hull(the_scene, square=True), the_scene.hand.section.width
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
    width, cap = the_scene.hand.section.width, LENGTH / 16
    # Half of |x|^4 + |y|^4 + |z|^4 <= 1 has the volume 4 gamma(5/4)^3 / gamma(7/4).
    volume = (LENGTH - cap + cap * 0.8106 / 0.9270) * 0.9270 * width * HEIGHT
    assert body.is_watertight
    np.testing.assert_allclose(body.volume, volume, rtol=0.01)


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="'hull' needs friction = 'coulomb' or 'none', not 'full'"):
        grasps.pinch("box", effects__surface="hull", effects__friction="full")
    with pytest.raises(InputError, match="hull_points = 6 must be a multiple of 4"):
        hull_scene(points=6)
    with pytest.raises(InputError, match="did you mean 'hull'"):
        scene.load("paper_spheres", overrides={"effects": {"surface": "hul"}})
