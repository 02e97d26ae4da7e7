"""Depths in the palm and in fingers that studies tell, of poses whose depth is known."""

import mujoco
import numpy as np
import pytest

from codesign_jax import model, scene
from codesign_jax.model import hull
from scripts.shared import depths
from tests.helpers import grasps


@pytest.fixture(scope="module")
def straight():
    """Scene, hand and one pose: the hand at the start, its fingers straight."""
    the_scene = scene.load("paper", overrides={"discretization": {"links": 3}})
    params, trial = grasps.hand_world(the_scene, length=0.1)
    compiled = model.compile_model(the_scene, params, trial)
    data = mujoco.MjData(compiled)
    return the_scene, params, depths.poses(compiled, data.qpos[None].copy())


def test_fingers_at_the_start_are_in_nothing(straight):
    the_scene, params, at = straight
    assert depths.in_palm(the_scene, params, at) == 0
    assert depths.in_fingers(the_scene, params, at)[1] == 0


@pytest.mark.parametrize("part", [0.05, 0.3, 0.9])
def test_a_face_is_as_deep_in_another_finger_as_it_was_moved_there(straight, part):
    """The middle of a side face, moved along the normal: depth part x half the width."""
    the_scene, params, at = straight
    lay, half = model.layout(the_scene), the_scene.hand.section.width / 2
    place, turn = at.place.copy(), at.turn.copy()
    one, other = lay.bodies[:2]
    turn[:, other] = turn[:, one]
    place[:, other] = place[:, one] + (2 - part) * half * turn[:, one][..., 1]
    found = depths.in_fingers(the_scene, params, depths.Poses(place, turn))
    share = part * half / min(2 * half, float(params.height[0]))
    np.testing.assert_allclose([found[0][0], found[1][0]], [part * half, share], rtol=1e-6)


@pytest.mark.parametrize("inside", [0.001, 0.004])
def test_a_tip_is_as_deep_in_another_one_as_their_faces_are(straight, inside):
    """Two fingers end on end: the way to the tip's face, not that to the sides, 9 mm away."""
    the_scene, params, at = straight
    lay = model.layout(the_scene)
    place, turn = at.place.copy(), at.turn.copy()
    one, other = lay.bodies[0], lay.bodies[1]
    along, across, up = np.moveaxis(turn[:, one], -1, 0)
    turn[:, other] = np.stack([-along, -across, up], -1)
    face = place[:, one] + 0.1 / 6 * along  # half a segment behind the last joint
    place[:, other] = face[:, -1:] + (0.1 / 6 - inside) * along[:, -1:]
    place[:, other[:-1]] = place[:, other[-1:]] + 1.0  # out of the way
    place[:, lay.bodies[2:]] += [2.0, 0.0, 0.0]
    found = depths.in_fingers(the_scene, params, depths.Poses(place, turn))
    np.testing.assert_allclose(found[0], inside, rtol=1e-6)


@pytest.mark.parametrize("inside", [0.001, 0.004])
def test_a_tip_is_as_deep_in_the_palm_as_its_face_is(straight, inside):
    """The palm stands across the first finger, whose tip's face is parallel to its underside."""
    the_scene, params, at = straight
    lay = model.layout(the_scene)
    place, turn = at.place.copy() + [1.0, 0, 0], at.turn.copy()  # out of the others' way
    bodies = [lay.stubs[0], *lay.bodies[0]]
    place[:, bodies] = at.place[:, bodies]
    tip = hull.pose(the_scene, 0.1, float(params.height[0]), place[0, bodies], turn[0, bodies])[-1]
    along = turn[0, bodies[-1], :, 0]
    frame = np.linalg.svd(along[None])[2].T  # its first column is along or against the finger
    turn[:, 1] = np.stack([frame[:, 1], np.cross(along, frame[:, 1]), along], 1)
    place[:, 1] = tip - inside * along
    found = depths.in_palm(the_scene, params, depths.Poses(place, turn))
    np.testing.assert_allclose(found, inside, rtol=1e-6)
