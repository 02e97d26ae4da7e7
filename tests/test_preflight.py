"""Preflight: what it refuses without simulating, and that an ordinary start costs no program."""

import dataclasses
import re

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import model, scene, start
from codesign_jax.commands import clearance, preflight
from codesign_jax.scene import parameters
from codesign_jax.types import Params
from tests.helpers.grasps import hand_world, pinch, random_worlds, still


def low_start():
    """The pinch scene with an arm that starts so low that long fingers reach table or box."""
    return pinch(links=2, arm__start_height=0.15)


def hands(scene, count):
    """Random hands of the whole table, NumPy arrays in float64 with leading axis (world,)."""
    params, _ = random_worlds(scene, 0, count)
    return Params(*(np.asarray(v, float) for v in params))


def single(designs):
    """The designs in float32."""
    return Params(*(v.astype(np.float32) for v in designs))


def test_lowest_point_bounds_mujocos_geoms():
    """MuJoCo C places the same hand: spheres lie above the bound, and not far above it."""
    scene = low_start()
    designs, gaps = hands(scene, 4), []
    starts = jax.jit(jax.vmap(lambda p: model.model_fields(scene, p, still()).start))
    for one, qpos in zip(zip(*designs, strict=True), starts(single(designs)), strict=True):
        one = Params(*one)
        compiled = model.compile_model(scene, one, still())
        data = mujoco.MjData(compiled)
        data.qpos[:] = qpos
        mujoco.mj_forward(compiled, data)
        names = [compiled.geom(g).name for g in range(compiled.ngeom)]
        spheres = [g for g, name in enumerate(names) if name.startswith(("finger", "palm"))]
        lowest = (data.geom_xpos[spheres, 2] - compiled.geom_size[spheres, 0]).min()
        gaps.append(lowest - clearance.lowest_point(scene, one))
    # Rounding of float32; half the section's width of 20 mm and half a link of 180 / 2 mm.
    assert -1e-6 < min(gaps) and max(gaps) < 0.010 + 0.045


def test_starts_inside_table_or_object_are_refused_and_those_called_clear_are_clear():
    scene = low_start()
    designs = hands(scene, 64)
    exact = np.asarray(clearance.depths(*clearance._arguments(scene, single(designs))))[0]
    low = [clearance.lowest_point(scene, Params(*one)) for one in zip(*designs, strict=True)]
    clear = np.array(low) >= 0.06  # the box's height
    assert clear.any() and (exact[clear] <= 0).all()
    deep = np.flatnonzero(exact > scene.limits.penetration)
    assert 0 < len(deep) < 64
    refusals = preflight.check(scene, designs).refusals
    assert [text.split(":")[0] for text in refusals] == [f"design {i}" for i in deep]
    for part in (f"starts {1e3 * exact[deep[0]]:.0f} mm", "'box'", "raise arm.start_height = 0.15"):
        assert part in refusals[0]


def test_fingers_overlap_as_deep_as_engines_find():
    """`start.depth_between`, of random hands whose mounts are close."""
    the_scene = scene.load("paper_spheres", overrides={"effects": {"finger_finger": True}})
    designs = hands(the_scene, 16)

    @jax.jit
    def depths(designs):
        fields = jax.vmap(lambda p: model.model_fields(the_scene, p, still()))(designs)
        return start.depth_between(the_scene, fields)

    with jax.enable_x64(True):
        exact = depths(designs)
    found = clearance.between_fingers(the_scene, designs)
    np.testing.assert_allclose(found, exact, atol=1e-12)
    assert np.ptp(found) > 0.003


@pytest.mark.parametrize("surface", ["hull", "spheres"])
def test_fingers_are_as_deep_in_the_palm_as_engines_find(surface):
    """`start.depth_in_palm`, of random hands with a finger that is mounted into the palm."""
    overrides = {"effects": {"finger_palm": True, "surface": surface}}
    overrides["limits"] = {"penetration": 0.002}
    the_scene = scene.load("paper_spheres", overrides=overrides)
    inwards = dataclasses.replace(the_scene.hand.finger[0], azimuth=180.0, tilt=-20.0)
    fingers = (inwards, *the_scene.hand.finger[1:])
    the_scene = dataclasses.replace(
        the_scene, hand=dataclasses.replace(the_scene.hand, finger=fingers)
    )
    designs = hands(the_scene, 8)

    @jax.jit
    def depths(designs):
        fields = jax.vmap(lambda p: model.model_fields(the_scene, p, still()))(designs)
        return start.depth_in_palm(the_scene, fields), start.invalid_start(the_scene, fields)

    with jax.enable_x64(True):
        exact, invalid = depths(designs)
    np.testing.assert_allclose(clearance.in_palm(the_scene, designs), exact, atol=1e-12)
    exact, invalid = np.asarray(exact), np.asarray(invalid)
    np.testing.assert_array_equal(invalid != 0, exact > 0.002)
    report = preflight.check(the_scene, designs)
    refused = sum("inside the palm" in line for line in report.refusals)
    assert refused == (exact > 0.002).sum() > 0


def test_an_ordinary_start_needs_no_program(monkeypatch):
    def never(*arguments):
        raise AssertionError("a program was compiled")

    monkeypatch.setattr(clearance, "depths", never)
    for preset in ("2d", "full"):
        scene = pinch()
        space = parameters.design_space(scene.hand, preset)
        ends = jax.vmap(space.params)(np.array([space.default(), space.low, space.high]))
        report = preflight.check(scene, ends._replace(pressure=0 * ends.pressure))
        assert report.refusals == []


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"wall": 0.015}, "leave no air chamber"),
        ({"length": -0.1}, "must be positive"),
        ({"length": np.nan}, "not a finite number"),
        ({"pressure": 5e5}, "above the limit of"),
    ],
)
def test_numbers_that_are_no_hand_are_refused(change, part):
    scene = pinch()
    space = parameters.design_space(scene.hand, "2d")
    designs = jax.vmap(space.params)(space.default()[None])
    wrong = designs._replace(**{k: 0 * getattr(designs, k) + v for k, v in change.items()})
    assert any(part in problem for problem in preflight.check(scene, wrong).refusals)


@pytest.mark.parametrize("surface", ["spheres", "hull"])
def test_fingers_inside_one_another_are_refused(surface):
    """Without a spread two pairs of the paper's fingers stand in one place: 20 mm deep."""
    effects = {"surface": surface, "finger_finger": True}
    the_scene = scene.load("paper_spheres", overrides={"effects": effects})
    both = [hand_world(the_scene, spread=np.deg2rad(x))[0] for x in (0.0, 60.0)]
    designs = Params(*(np.stack(v) for v in zip(*both, strict=True)))
    refusals = preflight.check(the_scene, designs, ["together", "apart"]).refusals
    assert len(refusals) == 1 and refusals[0].startswith(
        "together: fingers start 20 mm inside one another (limits.penetration = 10 mm)"
    )
    alone = scene.load("paper_spheres", overrides={"effects": {"surface": surface}})
    assert not preflight.check(alone, designs).refusals


def test_a_tilt_in_radians_is_warned_of():
    """It is a legal number of degrees."""
    hand = scene.load("paper").hand
    for tilt, warned in ((1.22, True), (-1.22, True), (0.0, False), (70.0, False)):
        fingers = (dataclasses.replace(hand.finger[0], tilt=tilt), *hand.finger[1:])
        tilted = dataclasses.replace(pinch(), hand=dataclasses.replace(hand, finger=fingers))
        words = f"hand.finger.0.tilt = {tilt:g} deg .* did you mean {np.degrees(tilt):.3g}?"
        found = [text for text in preflight._scene_warnings(tilted) if re.match(words, text)]
        assert len(found) == warned
