"""Mounts of the fingers: base points of their own or on a circle, and hands that can be built."""

import itertools

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import model, preflight, scene
from codesign_jax.scene import constants, hand, schema
from tests.helpers.grasps import DATA, hand_world

SPREADS = np.deg2rad([0.0, 30.0, 60.0, 90.0, 110.0])
CORNERS = list(itertools.product((0.010, 0.180), (0.015, 0.025)))  # lengths and heights of Table I


def coarse(name, **effects):
    """A built-in scene with one joint a finger, whose straight fingers are the same boxes."""
    return scene.load(name, overrides={"discretization": {"links": 1}, "effects": effects})


def closest(the_scene, **changes):
    """Smallest distance between boxes of two straight fingers by MuJoCo C [m], by pair."""
    params, trial = hand_world(the_scene, **changes)
    compiled = model.compile_model(the_scene, params, trial, visual=True)
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    names = [compiled.geom(g).name for g in range(compiled.ngeom)]
    blocks = [
        [g for g, name in enumerate(names) if name.startswith(f"finger_{f}_block")]
        for f in range(the_scene.num_fingers)
    ]
    assert [len(b) for b in blocks] == [2] * the_scene.num_fingers  # stub and link
    return {
        (a, b): min(
            mujoco.mj_geomDistance(compiled, data, g, h, 1.0, None)
            for g, h in itertools.product(blocks[a], blocks[b])
        )
        for a, b in itertools.combinations(range(the_scene.num_fingers), 2)
    }


def test_sections_of_the_papers_hand_do_not_overlap_at_any_spread():
    """Lengths and heights only move faces outwards: the largest boxes contain all others.

    So equal fingers of the table's corners are enough; MuJoCo C measures the boxes.
    """
    the_scene = coarse("paper", surface="spheres", finger_finger=False)
    for (length, height), spread in itertools.product(CORNERS, SPREADS):
        gaps = closest(the_scene, length=length, height=height, spread=spread)
        # Centres of a pair are 26 mm apart and sections 20 mm wide: turning outwards moves no
        # edge nearer to the plane between them. 1 nm is rounding.
        assert min(gaps[0, 1], gaps[2, 3]) > 0.006 - 1e-9
        # Inner edges of the two pairs stand at least 25 mm - 10 mm sin(55 degrees) from the centre.
        assert min(gaps[pair] for pair in ((0, 2), (0, 3), (1, 2), (1, 3))) > 0.033


def test_sections_on_a_circle_do_overlap():
    """What the test above can see: bases on a circle stand in one another below 44 degrees."""
    the_scene = coarse("paper_spheres")
    assert closest(the_scene, spread=np.deg2rad(30.0))[0, 1] < -0.003
    assert closest(the_scene, spread=np.deg2rad(50.0))[0, 1] > 0.0


def test_contact_between_fingers_finds_none_at_rest():
    the_scene = coarse("paper")
    corners = itertools.product(CORNERS, SPREADS[[0, -1]])
    worlds = [hand_world(the_scene, length=n, height=h, spread=s)[0] for (n, h), s in corners]
    designs = jax.tree.map(lambda *v: np.stack(v), *worlds)
    thin = designs._replace(wall=0 * designs.wall + 0.005)
    assert not preflight.refusals(the_scene, thin, [*map(str, range(len(worlds)))])


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


def test_base_points_are_constants():
    """One traced program takes any base points; a circle through a base point gives its place."""
    the_scene = coarse("paper")
    start = the_scene.constants()
    assert start.hand.finger[1].base == (0.036, -0.0175) and not hasattr(
        start.hand.finger[1], "radius"
    )
    params, trial = hand_world(the_scene, spread=0.4)
    params = jax.tree.map(np.float32, params)

    @jax.jit
    def places(values):
        fields = model.model_fields(the_scene.with_constants(values), params, trial)
        return fields.body_pos[model.layout(the_scene).stubs]

    moved = tuple(f._replace(base=(f.base[0] + 0.01, f.base[1])) for f in start.hand.finger)
    other = start._replace(hand=start.hand._replace(finger=moved))
    constants.check(the_scene, other)
    # Rounding of float32 of numbers of some 0.01 m.
    np.testing.assert_allclose(places(other) - places(start), [[0.01, 0, 0]] * 4, atol=1e-8)
    far = tuple(f._replace(base=(0.3, 0.0)) for f in start.hand.finger)
    with pytest.raises(schema.InputError, match=r"finger\[0\].base\[0\] = 0.3 is outside"):
        constants.check(the_scene, start._replace(hand=start.hand._replace(finger=far)))


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("radius = 0.035\n", "", "finger[0] has no base point: give base = [x, y]"),
        (
            "radius = 0.035\n",
            "radius = 0.035\nbase = [0.02, 0.01]\n",
            "gives its base point twice: leave out base = [0.02, 0.01] or radius = 0.035",
        ),
        ("radius = 0.035\n", "base = [0.02]\n", "base = [0.02] must have two entries"),
        ("radius = 0.035\n", "base = [25, 0.01]\n", "base[0] = 25 is outside [-0.2, 0.2] m"),
        ("radius = 0.035\n", "base = 0.02\n", "base must be an array, not float"),
    ],
)
def test_mounts_that_say_nothing_or_too_much_are_refused(tmp_path, old, new, part):
    text = (DATA / "pinch.toml").read_text()
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(schema.InputError) as error:
        hand.load(tmp_path / "bad.toml")
    assert len(error.value.problems) == 1 and part in error.value.problems[0]
