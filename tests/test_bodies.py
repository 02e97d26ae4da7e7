"""What a viewer draws: fingers skinned as in MuJoCo, objects of their size."""

import mujoco
import numpy as np
import pytest
import trimesh

from codesign_jax import model
from codesign_jax.report import bodies
from tests.helpers import grasps
from tests.helpers.replays import bent_grasp


def test_fingers_move_as_in_mujoco():
    """Skins of MuJoCo's own linear blend skinning, and the palm where its disc is."""
    the_scene = grasps.pinch("box", links=4, effects__surface="hull")
    grasp = bent_grasp(the_scene)
    shown, motion = bodies.parts(the_scene, grasp), bodies.motion(the_scene, grasp, rate=1000.0)
    assert motion.rate == pytest.approx(1 / the_scene.discretization.timestep)
    compiled = model.compile_model(the_scene, grasp.params, grasp.trial, visual=True)
    data, view = mujoco.MjData(compiled), mujoco.MjvScene(compiled, maxgeom=100)
    every, camera = int(mujoco.mjtCatBit.mjCAT_ALL), mujoco.MjvCamera()
    for q, pose in zip(grasp.qpos, motion.pose, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(compiled, data)
        mujoco.mjv_updateScene(compiled, data, mujoco.MjvOption(), None, camera, every, view)
        theirs = np.asarray(view.skinvert).reshape(the_scene.num_fingers, -1, 3)
        ours = [bodies.vertices(part, pose) for part in shown[: the_scene.num_fingers]]
        np.testing.assert_allclose(ours, theirs, atol=2e-7)  # float32 of both
        palm = bodies.vertices(shown[-2], pose)
        centre = data.geom("palm_disc").xpos
        np.testing.assert_allclose(palm.mean(0), centre, atol=1e-6)


@pytest.mark.parametrize("name", grasps.SHAPES)
def test_objects_have_their_size(name):
    """Volume of the drawn mesh against the solid's; round ones are polyhedra inside it."""
    the_scene = grasps.pinch(name)
    a, b, c = the_scene.objects.object[0].half_sizes
    ball = 4 / 3 * np.pi * a**3
    solid = {
        "box": 8 * a * b * c,
        "cylinder": 2 * np.pi * a**2 * b,
        "capsule": 2 * np.pi * a**2 * b + ball,
        "sphere": ball,
    }
    mesh = trimesh.Trimesh(*bodies.object_mesh(the_scene, 0))
    assert mesh.is_watertight
    # A prism of 64 sides has 0.16 % less than its cylinder, an icosphere of 5120 faces 0.2 %.
    assert mesh.volume == pytest.approx(solid[name], rel=3e-3)


def test_large_meshes_are_drawn_coarser():
    fine = trimesh.creation.icosphere(7, 0.03)  # 327,680 faces
    vertices, faces = bodies._coarse(np.asarray(fine.vertices), np.asarray(fine.faces))
    assert len(faces) <= bodies._MOST_FACES
    distance = np.linalg.norm(vertices[faces].mean(1), axis=1)
    assert np.abs(distance - 0.03).max() < 0.001  # of a cell of at most 0.06 m / 84
