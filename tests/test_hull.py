"""The hull's mesh: closed, as large as the finger, skinned as MuJoCo's renderer skins it."""

import mujoco
import numpy as np
import pytest
import trimesh

from codesign_jax import model, scene
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


def bent(the_scene, seed=0):
    """Model and data of a hand with random joint angles of up to 0.4 rad."""
    params, trial = grasps.hand_world(the_scene, length=LENGTH, height=HEIGHT)
    compiled = model.compile_model(the_scene, params, trial, visual=True)
    data = mujoco.MjData(compiled)
    turn = np.random.default_rng(seed).uniform(-0.4, 0.4, data.qpos.shape)
    data.qpos[:-7] += turn[:-7]
    mujoco.mj_kinematics(compiled, data)
    return compiled, data


def test_skinning_equals_mujoco(tmp_path):
    """Bent fingers have the vertices of MuJoCo's own linear blend skinning, and are exported."""
    the_scene = hull_scene()
    compiled, data = bent(the_scene)
    view = mujoco.MjvScene(compiled, maxgeom=100)
    mujoco.mj_forward(compiled, data)
    every, camera = int(mujoco.mjtCatBit.mjCAT_ALL), mujoco.MjvCamera()
    mujoco.mjv_updateScene(compiled, data, mujoco.MjvOption(), None, camera, every, view)
    lay, mesh, fingers = model.layout(the_scene), hull.hull(the_scene), []
    for f in range(the_scene.num_fingers):
        links = [lay.stubs[f], *lay.bodies[f]]
        turn = data.xmat[links].reshape(-1, 3, 3)
        fingers.append(hull.pose(the_scene, LENGTH, HEIGHT, data.xpos[links], turn))
    theirs = np.asarray(view.skinvert).reshape(len(fingers), -1, 3)
    np.testing.assert_allclose(np.stack(fingers), theirs, atol=1e-7)  # theirs are float32
    path = hull.write(tmp_path / "hand.ply", fingers, mesh.face)
    read = trimesh.load(path)
    assert read.is_watertight and len(read.split()) == len(fingers)


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="'hull' needs friction = 'coulomb' or 'none', not 'full'"):
        grasps.pinch("box", effects__surface="hull", effects__friction="full")
    with pytest.raises(InputError, match="hull_points = 6 must be a multiple of 4"):
        hull_scene(points=6)
    with pytest.raises(InputError, match="did you mean 'hull'"):
        scene.load("paper_spheres", overrides={"effects": {"surface": "hul"}})
