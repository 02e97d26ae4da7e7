"""Preflight: what it refuses without simulating; mounts of fingers, and hands that can be built."""

import dataclasses
import itertools

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import model, preflight, scene, start
from codesign_jax.model.layout import first_on_palm
from codesign_jax.scene import hand, schema
from tests.helpers.grasps import DATA, hand_world, random_worlds, still


def hands(scene, count):
    """Random hands of the whole table, NumPy arrays in float64 with leading axis (world,)."""
    params, _ = random_worlds(scene, 0, count)
    return jax.tree.map(lambda v: np.asarray(v, float), params)


def deepest(compiled, data, geoms, others):
    """Deepest overlap [m] of a geom with one of the others' by MuJoCo C."""
    pairs = itertools.product(geoms, others)
    return -min(mujoco.mj_geomDistance(compiled, data, a, b, 1.0, None) for a, b in pairs)


def test_fingers_and_palm_are_as_deep_in_one_another_as_mujocos_geoms():
    """By `start`, of hands with a sphere a link and a finger that is mounted into the palm."""
    effects = {"finger_finger": True, "finger_palm": True}
    sizes = {"links": 3, "spheres_per_link": 1}
    changes = {"effects": effects, "discretization": sizes, "limits": {"penetration": 0.002}}
    the_scene = scene.load("paper_spheres", overrides=changes)
    inwards = dataclasses.replace(the_scene.hand.finger[0], azimuth=180.0, tilt=-20.0)
    mounted = dataclasses.replace(the_scene.hand, finger=(inwards, *the_scene.hand.finger[1:]))
    the_scene = dataclasses.replace(the_scene, hand=mounted)
    designs = hands(the_scene, 6)

    @jax.jit
    def of_engines(designs):
        fields = jax.vmap(lambda p: model.model_fields(the_scene, p, still()))(designs)
        tests = start.depth_between, start.depth_in_palm, start.invalid_start
        return fields.start, *(test(the_scene, fields) for test in tests)

    with jax.enable_x64(True):
        places, between, palm, invalid = map(np.asarray, of_engines(designs))
    for i in range(len(places)):
        one = jax.tree.map(lambda v, i=i: v[i], designs)
        compiled = model.compile_model(the_scene, one, still())
        data = mujoco.MjData(compiled)
        data.qpos[:] = places[i]
        mujoco.mj_kinematics(compiled, data)
        name = "finger_{}_sphere_{}_0".format
        fingers = [[compiled.geom(name(f, k)).id for k in (1, 2, 3)] for f in range(4)]
        pairs = itertools.combinations(fingers, 2)
        # MuJoCo's own iteration for a sphere and a cylinder ends at 1e-6.
        found = max(deepest(compiled, data, a, b) for a, b in pairs)
        assert between[i] == pytest.approx(found, abs=1e-6)
        first = first_on_palm(3) - 1
        disc = [compiled.geom("palm_disc").id]
        found = max(deepest(compiled, data, links[first:], disc) for links in fingers)
        assert palm[i] == pytest.approx(found, abs=1e-6)
    deep = np.maximum(between, palm) > 0.002
    assert 0 < deep.sum() and palm.max() > 0.002
    np.testing.assert_array_equal(invalid != 0, deep)
    found = preflight.refusals(the_scene, designs, [*map(str, range(len(deep)))])
    assert {line.split(":")[0] for line in found} == {str(i) for i in np.flatnonzero(deep)}


@pytest.mark.parametrize("surface", ["hull", pytest.param("spheres", marks=pytest.mark.slow)])
def test_fingers_inside_one_another_are_refused(surface):
    """Without a spread two pairs of the paper's fingers stand in one place: 20 mm deep."""
    effects = {"surface": surface, "finger_finger": True}
    the_scene = scene.load("paper_spheres", overrides={"effects": effects})
    both = [hand_world(the_scene, spread=np.deg2rad(x))[0] for x in (0.0, 60.0)]
    designs = jax.tree.map(lambda *v: np.stack(v), *both)
    refusals = preflight.refusals(the_scene, designs, ["together", "apart"])
    assert len(refusals) == 1 and refusals[0].startswith(
        "together: fingers start 20 mm inside one another (limits.penetration = 10 mm)"
    )


# --- mounts of fingers ----------------------------------------------------------------------------


def coarse(name, **effects):
    """A built-in scene with one joint a finger, whose straight fingers are the same boxes."""
    return scene.load(name, overrides={"discretization": {"links": 1}, "effects": effects})


@pytest.mark.parametrize("spread", [0.0, 1.1])
def test_base_points_stay_and_directions_turn(spread):
    """Place and direction of a finger from MuJoCo's kinematics, against the file's numbers."""
    the_scene = coarse("paper", surface="spheres", finger_finger=False)
    params, trial = hand_world(the_scene, spread=spread)
    compiled = model.compile_model(the_scene, params, trial)
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    to_palm = data.body("palm").xmat.reshape(3, 3).T
    for i, finger in enumerate(the_scene.hand.finger):
        root = data.body(f"finger_{i}_link_0")
        place = to_palm @ (root.xpos - data.body("palm").xpos)
        assert finger.base is not None
        np.testing.assert_allclose(place, [*finger.base, 0.0], atol=1e-9)
        azimuth, tilt = np.deg2rad(finger.azimuth) + finger.spread * spread, np.deg2rad(finger.tilt)
        level = np.cos(tilt) * np.array([np.cos(azimuth), np.sin(azimuth)])
        along = to_palm @ root.xmat.reshape(3, 3)[:, 0]
        np.testing.assert_allclose(along, [*level, -np.sin(tilt)], atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("radius = 0.035\n", "", "finger[0] has no base point: give base = [x, y]"),
        (
            "radius = 0.035\n",
            "radius = 0.035\nbase = [0.02, 0.01]\n",
            "gives its base point twice: leave out base = [0.02, 0.01] or radius = 0.035",
        ),
        ("radius = 0.035\n", "base = [25, 0.01]\n", "base[0] = 25 is outside [-0.2, 0.2] m"),
    ],
)
def test_mounts_that_say_nothing_or_too_much_are_refused(tmp_path, old, new, part):
    text = (DATA / "pinch.toml").read_text()
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(schema.InputError) as error:
        hand.load(tmp_path / "bad.toml")
    assert len(error.value.problems) == 1 and part in error.value.problems[0]
