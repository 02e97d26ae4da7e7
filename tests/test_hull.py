"""The hull's mesh: closed, as large as the finger, skinned as MuJoCo's renderer skins it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from codesign_jax import model, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.laws import hull as skin
from codesign_jax.engines.structured.laws.cones import make_cone
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.laws.kinematics import kinematics
from codesign_jax.engines.structured.linear.tree import Spatial, relative
from codesign_jax.model import hull
from codesign_jax.scene.schema import InputError
from tests.helpers import grasps

LENGTH, HEIGHT = 0.11, 0.018


def hull_scene(links=4, rings=2, points=8):
    density = {"discretization__hull_rings": rings, "discretization__hull_points": points}
    return grasps.pinch("box", links=links, effects__surface="hull", **density)


@pytest.mark.parametrize(("links", "rings", "points"), [(1, 1, 4), (4, 2, 8), (3, 5, 20)])
def test_mesh_is_the_closed_block_of_the_finger(links, rings, points):
    """Watertight, faces outwards, with the block's volume and surface; trimesh measures them."""
    the_scene = hull_scene(links, rings, points)
    mesh, width = hull.hull(the_scene), the_scene.hand.section.width
    body = trimesh.Trimesh(hull.rest(the_scene, LENGTH, HEIGHT), mesh.face, process=False)
    assert body.is_watertight and body.is_winding_consistent
    np.testing.assert_allclose(body.volume, LENGTH * width * HEIGHT, rtol=1e-12)
    np.testing.assert_allclose(mesh.weight.sum(1), 1.0, atol=1e-12)
    assert (mesh.weight >= -1e-12).all()
    # Shares of the contact points: all of the surface but the base and half a ring's step there.
    shares = hull.slots(the_scene).area.sum((1, 2)) @ [
        LENGTH / links * width,
        LENGTH / links * HEIGHT,
        width * HEIGHT,
    ]
    outline = 2 * (width + HEIGHT)
    missing = width * HEIGHT + outline * LENGTH / links / rings / 2
    np.testing.assert_allclose(shares, body.area - missing, rtol=1e-12)


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


def test_velocities_are_derivatives_of_positions():
    """Point motion of every vertex against central differences, and without its exact image."""
    with jax.enable_x64(True):
        the_scene = hull_scene()
        _, data = bent(the_scene)
        hand, trial = grasps.hand_world(the_scene, length=LENGTH, height=HEIGHT)
        fields, _ = grasps.world_inputs(the_scene, hand, trial)
        fields = grasps.repeat(fields, 1)
        engine, lanes = StructuredEngine(the_scene), grasps.lanes(the_scene, fields)
        rate = np.random.default_rng(1).normal(size=data.qvel.shape)
        rate[-6:] = 0.0  # the object's are no differences of its coordinates

        @jax.jit
        def at(h):
            qpos = data.qpos + h * np.append(rate, 0.0)
            state = grasps.lanes_state(engine, the_scene, fields, qpos, rate)
            kin = kinematics(lanes, model.layout(the_scene).axes, state)
            return kin, skin.vertices(the_scene, lanes, kin), state.position[:, 0, 0]

        kin, points, _ = at(0.0)
        zero, cone = jnp.zeros_like(points.point), make_cone(the_scene, 0.5, bodies=1)
        motion = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
        rel = relative("hull_table", motion)
        contacts = Contacts(points.point, zero, zero[0], cone, points.weight * points.image)
        moved = jax.jit(Contacts.relative)(contacts, rel)
        h = 1e-5
        ends = [v.point + origin[:, None, None, None, None] for _, v, origin in (at(h), at(-h))]
        difference = (ends[0] - ends[1]) / (2 * h)
        # Error h^2 times third derivatives of lengths of 0.3 m at rates of a few rad/s.
        np.testing.assert_allclose(moved, difference, atol=1e-8)
        # One common point instead of the images would be wrong by far more than that.
        blended = points.point - jnp.concatenate([kin.origin, kin.origin[:, -1:]], 1)[:, :, None]
        common = contacts._replace(lever=points.weight * blended)
        common = jax.jit(Contacts.relative)(common, rel)
        assert np.abs(common - difference).max() > 1e-3 * np.abs(difference).max()


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_other_engines_refuse_the_hull(engine):
    with pytest.raises(
        InputError, match=f'engine {engine}: effects.surface = "hull".*use engine structured'
    ):
        make_engine(engine, hull_scene())


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="'hull' needs friction = 'coulomb' or 'none', not 'full'"):
        grasps.pinch("box", effects__surface="hull", effects__friction="full")
    with pytest.raises(InputError, match="hull_points = 6 must be a multiple of 4"):
        hull_scene(points=6)
    with pytest.raises(InputError, match="did you mean 'hull'"):
        scene.load("paper_spheres", overrides={"effects": {"surface": "hul"}})
