"""Preflight: what it refuses without simulating."""

import dataclasses
import itertools
import re

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import model, preflight, scene, start
from codesign_jax.model.layout import first_on_palm
from codesign_jax.scene import parameters
from tests.helpers.grasps import hand_world, pinch, random_worlds, still


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


def test_starts_inside_table_or_object_are_refused():
    """Straight fingers of 180 mm, 75 degrees down from 150 mm: as deep as MuJoCo C finds."""
    the_scene = pinch(arm__start_height=0.15)
    worlds = [hand_world(the_scene, length=length)[0] for length in (0.08, 0.18)]
    designs = jax.tree.map(lambda *v: np.stack(v), *worlds)
    [refusal] = preflight.refusals(the_scene, designs, ["short", "long"])
    assert refusal.startswith("long: starts 17 mm inside the table or object 'box'")
    assert refusal.endswith("raise arm.start_height = 0.15 m")


def test_a_pressure_above_its_limit_is_refused():
    scene = pinch()
    space = parameters.design_space(scene.hand, "2d")
    designs = jax.vmap(space.params)(space.default()[None])
    wrong = designs._replace(pressure=0 * designs.pressure + 5e5)
    assert "above the limit of" in preflight.refusals(scene, wrong, ["a design"])[0]


@pytest.mark.parametrize("surface", ["spheres", "hull"])
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
    alone = scene.load("paper_spheres", overrides={"effects": {"surface": surface}})
    assert not preflight.refusals(alone, designs, ["together", "apart"])


def test_a_tilt_in_radians_is_warned_of():
    """It is a legal number of degrees."""
    hand = scene.load("paper").hand
    for tilt, warned in ((1.22, True), (-1.22, True), (0.0, False), (70.0, False)):
        fingers = (dataclasses.replace(hand.finger[0], tilt=tilt), *hand.finger[1:])
        tilted = dataclasses.replace(pinch(), hand=dataclasses.replace(hand, finger=fingers))
        words = f"hand.finger.0.tilt = {tilt:g} deg .* did you mean {np.degrees(tilt):.3g}?"
        found = [text for text in preflight._scene_warnings(tilted) if re.match(words, text)]
        assert len(found) == warned
