"""Depths that `scripts.contact_depths` tells, of poses whose depth is known."""

import numpy as np
import pytest

from scripts import contact_depths
from tests.helpers import dense_skin
from tests.helpers.dense_skin import turned

LENGTH, WIDTH, HEIGHT = 0.11, 0.024, 0.020


def tube(body, height=0.0):
    """A finger of one state, moved up."""
    joints = body.joints + [0, 0, height]
    size = body.length, body.width, body.height
    return contact_depths.tube(joints[None], body.frames[None], size)


@pytest.mark.parametrize("depth", [-1e-3, 0.5e-3, 3e-3, 8e-3])
@pytest.mark.parametrize("angle", [0, 30, 90])
def test_a_finger_is_as_deep_in_another_one_as_it_was_moved(angle, depth):
    """Across, along, and a tip that comes from above, whose end is nearer than its sides."""
    turn = turned([0, 0, 1], np.radians(angle))
    across = dense_skin.finger(LENGTH, base=[0.055, 0, 0] - turn[:, 0] * 0.055, turn=turn)
    down = turned([0, 1, 0], np.pi / 2)
    above = dense_skin.finger(LENGTH, base=[0.045, 0, LENGTH], turn=down)
    one = tube(dense_skin.finger(LENGTH))
    for other in (tube(across, HEIGHT - depth), tube(above, HEIGHT - depth)):
        for a, b in ((one, other), (other, one)):
            found = contact_depths.in_tube(a.rings, b)
            np.testing.assert_allclose(found, [max(depth, 0)], atol=0.05e-3)


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_an_edge_of_an_object_is_in_a_finger(kind):
    """An object that stands with an edge in a finger; and a finger in its face."""
    shape = type("Shape", (), {"type": kind})
    size, depth = np.array([0.03, 0.03, 0.03]), 2e-3
    edges, skin = contact_depths.surface(shape, size)
    one = tube(dense_skin.finger(LENGTH))
    inclined = turned([0, 1, 0], np.pi / 4)
    low = (edges @ inclined.T)[:, 2].min()
    at = np.array([0.0567, 0, HEIGHT - depth - low])
    assert (skin @ inclined.T)[:, 2].min() > low - 1e-9
    found = contact_depths.in_tube((edges @ inclined.T + at)[None, :, None], one)
    np.testing.assert_allclose(found, depth, atol=0.1e-3)
    away = one.rings.reshape(1, -1, 3) - [0.055, 0, HEIGHT - depth + size[2]]
    np.testing.assert_allclose(contact_depths.in_object(kind, size, away), depth, atol=1e-6)
