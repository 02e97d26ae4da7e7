"""Figures, animations and what a viewer draws show what they should."""

import av
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from codesign_jax import model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.report import animation, bodies
from codesign_jax.scene import parameters
from tests.helpers import grasps
from tests.helpers.replays import bent_grasp
from tests.helpers.toy_engine import TINY


@pytest.fixture(scope="module")
def grasp():
    """A scene and one simulated grasp in it."""
    the_scene = scene.load(TINY)
    space = parameters.design_space(the_scene.hand, "2d")
    trials = rollout.sample_trials(the_scene, jax.random.key(0), 1)
    params = space.params(jnp.asarray([0.1, 0.0]))
    [replay] = animation.replay(the_scene, make_engine("mujoco", the_scene), params, trials)
    return the_scene, replay


def test_a_picture_shows_the_object_where_a_pinhole_camera_does(grasp):
    the_scene, replay = grasp
    side, away, place = 200, 0.6, np.array(replay.qpos[0, -7:-4])
    camera = animation.Camera(azimuth=90.0, elevation=0.0, distance=away, lookat=(0.0, 0.0, 0.1))
    [picture] = animation.frames(the_scene, replay, np.zeros(1), size=(side, side), camera=camera)
    focal = side / 2 / np.tan(np.radians(45.0) / 2)  # MuJoCo's field of view
    wanted = side / 2 + focal * np.array([place[0], 0.1 - place[2]]) / (away + place[1])
    red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
    found = np.argwhere(red > blue + 60)[:, ::-1].mean(0)  # orange; the hand is above it
    np.testing.assert_allclose(found + 0.5, wanted, atol=1.5)  # its near faces are larger


def test_gif_plays_in_real_time(grasp, tmp_path):
    the_scene, replay = grasp
    path = tmp_path / "new" / "grasp.gif"
    animation.write_film(the_scene, [replay, replay], path, size=(80, 60))
    with Image.open(path) as image:
        assert image.size == (160, 60)
        total = 0
        for k in range(image.n_frames):
            image.seek(k)
            total += image.info["duration"]
    assert total == pytest.approx(1000 * the_scene.end_time, abs=80)  # one frame at most


def test_mp4_plays_in_real_time_with_even_sides(grasp, tmp_path):
    """Read back by FFmpeg: players need even sides, so an odd one has its edge twice."""
    the_scene, replay = grasp
    path = animation.write_film(the_scene, [replay], tmp_path / "g.mp4", size=(81, 61))
    with av.open(str(path)) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 25
    assert pictures[0].shape == (62, 82, 3)
    assert len(pictures) == round(25 * the_scene.end_time)
    drawn = animation.frames(the_scene, replay, np.array([0.0]), size=(81, 61))[0]
    # Colours are kept for blocks of four pixels alone, so that lines of one pixel blur.
    assert np.abs(pictures[0][:61, :81].astype(int) - drawn).mean() < 6


# --- what a viewer draws --------------------------------------------------------------------------


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
