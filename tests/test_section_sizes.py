"""Sections under their pressure in what measures and draws recorded poses."""

import base64
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from codesign_jax import section_sizes
from codesign_jax.judge import stress
from codesign_jax.model.layout import layout
from codesign_jax.report import animation, bodies, viewer
from codesign_jax.report.replay import Camera
from codesign_jax.scene import section_growth
from codesign_jax.studio import tab
from codesign_jax.types import Outcome, Trace
from scripts import contact_depths
from tests.helpers import curled_hands, grasps

HULL = {"effects__surface": "hull"}
GROWING = HULL | {"effects__section_growth": True}
PRESSURE = 60e3
SOFTER = 0.8
"""Over the shear modulus, of the trial's silicone."""


def world(the_scene, **changes):
    params, trial = grasps.hand_world(the_scene, length=0.1, pressure=PRESSURE, **changes)
    return params, trial._replace(stiffness=np.array(SOFTER))


def largest(the_scene, params):
    """Factors of width and height at the full pressure, alike for all fingers."""
    height, wall = (float(v[0]) for v in (params.height, params.wall))
    law = section_growth.growth(
        *np.array([height, wall, the_scene.hand.section.width]),
        shear_modulus=SOFTER * the_scene.hand.material.shear_modulus,
        thread_depth=the_scene.hand.section.thread_depth,
    )
    grown = section_growth.factors(law, np.array(PRESSURE))
    return float(grown[1]), float(grown[0])


def test_links_have_the_sizes_by_which_the_engine_finds_their_contacts():
    """At the pressures of the key frames and of a policy; all else is as it was made."""
    the_scene = grasps.pinch("box", **GROWING)
    params, trial = world(the_scene)
    lay = layout(the_scene)
    fields, ctrl = grasps.world_inputs(the_scene, params, trial)
    growth = section_growth.Growth(*np.moveaxis(np.asarray(fields.growth), -1, 0))
    planned = np.asarray(ctrl)
    for given in (None, 0.5 * planned[300:350]):
        sizes = section_sizes.of_bodies(the_scene, params, trial, given)
        used = planned if given is None else given
        height, width = section_growth.factors(growth, used[:, 6:, None])
        expected = np.stack([np.repeat(v, lay.links, 2) for v in (width, height)], -1)
        np.testing.assert_allclose(sizes[:, lay.bodies], expected, rtol=1e-6)  # float32
        others = np.setdiff1d(np.arange(sizes.shape[1]), lay.bodies)
        assert (sizes[:, others] == 1).all() and sizes.max() > 1.05
    assert (section_sizes.of_bodies(grasps.pinch("box", **HULL), params, trial) == 1).all()


@pytest.fixture(scope="module")
def crossed():
    """Scene, hand, trial and positions of a grasp with fingers in one another and in the object.

    Of sections that grow, of those as they were made, and of a hand that is made as large.
    """
    phases = grasps.hurried(0.02, 0.1, 0.12, 0.2, without="ungrasp")
    growing, made = (grasps.pinch("box", **phases | effects) for effects in (GROWING, HULL))
    params, trial = world(growing)
    wide, high = largest(growing, params)
    width = wide * growing.hand.section.width
    larger = grasps.pinch("box", **phases | HULL, section__width=width)
    state = curled_hands.state(growing, 3, 0.6, 0.07)[1]
    qpos = np.tile(state, (growing.num_steps, 1))
    same = (growing, params), (made, params), (larger, params._replace(height=high * params.height))
    return [(*pair, trial, qpos) for pair in same]


def shown_grasp(params, trial, qpos):
    numbers = np.zeros(()), np.zeros((), int), np.array(np.inf), np.array(-1)
    return animation.Replay(params, trial, Outcome(*numbers), qpos)


def in_the_studio(the_scene, params, trial, qpos):
    grasp = shown_grasp(params, trial, qpos)
    fingers, _ = tab.deepest_overlap(the_scene, grasp).split(" mm in fingers")
    return float(fingers.removeprefix("Deepest overlap: "))


def in_the_study(the_scene, params, trial, qpos):
    states = qpos[int(the_scene.last_step("approach")) :]
    depths = contact_depths.measure(the_scene, params, trial, states, {})
    return [depths[f"{name}_surface_mm"] for name in ("finger", "object")]


def in_the_stress(the_scene, params, trial, qpos):
    """Its warning names depths from 3 mm on, if they are a third of a finger."""
    grasp = shown_grasp(params, trial, qpos)
    outcomes, trials = grasps.repeat((grasp.outcome, trial), 1)
    trace = Trace(*np.zeros((3, 1, len(qpos))), qpos[None])
    lines = stress.of_grasps(the_scene, params, outcomes, trace, trials)
    depths = re.findall(r"stands (\d+) mm deep in finger", "\n".join(lines))
    return [*map(float, depths)] or [0.0]


@pytest.mark.parametrize("told", [in_the_studio, in_the_study, in_the_stress])
def test_depths_are_those_of_a_hand_that_is_made_as_large(crossed, told):
    growing, made, larger = (told(*case) for case in crossed)
    np.testing.assert_allclose(growing, larger, atol=0.011)  # of hundredths of a millimetre
    assert np.max(np.subtract(growing, made)) > 3.0


def test_a_picture_shows_the_section_of_its_moment(crossed):
    """Of straight fingers: as high over the fabric and as wide as their sections then are."""
    the_scene, params, trial, qpos = crossed[0]
    straight = qpos.copy()
    straight[:, layout(the_scene).dofs] = 0.0
    grasp = shown_grasp(params, trial, straight)
    motion = bodies.motion(the_scene, grasp, rate=100.0)
    width, height = np.transpose(largest(the_scene, params))
    for step, (wide, high) in ((0, (1.0, 1.0)), (-1, (width, height))):
        shown = bodies.parts(the_scene, grasp)
        corners = bodies.vertices(shown[0], motion.pose[step], motion.size[step])
        # By the frame of its last link
        *place, w, x, y, z = motion.pose[step, layout(the_scene).bodies[0, -1]]
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        local = (corners - place) @ turn
        beyond = local[:, 0] > 0
        extent = np.ptp(local[beyond], axis=0)
        section = the_scene.hand.section.width * wide, params.height[0] * high
        np.testing.assert_allclose(extent[1:], section, rtol=1e-4)  # float32 of poses
        np.testing.assert_allclose(local[beyond, 2].min(), 0.0, atol=1e-6)
    camera = Camera(distance=0.4)
    ends = np.array([0.0, the_scene.end_time - 0.02])
    pictures = animation.frames(the_scene, grasp, ends, size=(120, 120), camera=camera)
    blue = [(p[..., 2] > p[..., 0].astype(int) + 60).sum() for p in pictures]
    assert blue[1] > 1.05 * blue[0], "an inflated finger covers more of a picture"
    sizes = np.frombuffer(base64.b64decode(viewer.data(the_scene, grasp)["sizes"]), "<f4")
    assert sizes.max() == pytest.approx(max(width, height), rel=1e-5)
    still = viewer.data(crossed[1][0], grasp)
    assert still["sizes"] is None
