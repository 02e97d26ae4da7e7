"""The law of sections in the engines: fingers at rest, energy, instability, and what is refused."""

import functools
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

from codesign_jax import model, preflight
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.model import morphology
from codesign_jax.scene import section_growth
from scripts.section import study
from scripts.shared import energy
from tests.helpers import curled_hands, grasps, oracles
from tests.helpers.refusals import refusal

DATA = Path(__file__).parents[1] / "docs" / "data"
LAW = {
    "section__law": "elements",
    "section__width": 24e-3,
    "effects__neo_hookean": True,
    "effects__gravity": False,
}
SETTINGS = LAW | {
    "effects__surface": "hull",
    "discretization__integrator": "newmark",
}
STEPS = 200
PRESSURES = 20e3, 50e3
"""Of free fingers [Pa], at the modulus of the elements' study."""


class Simulated(NamedTuple):
    """Paths of worlds: fingers in the air at two pressures, and thin ones that press on a box."""

    scene: object
    params: list
    angles: np.ndarray  # of the joints, (world, time, finger, link, axis)
    rise: np.ndarray  # the most that a world gains, over the energy of its fingers


@pytest.fixture(scope="module")
def simulated():
    with jax.enable_x64(True):
        the_scene = grasps.pinch("box", **SETTINGS)
        modulus = float(the_scene.hand.material.shear_modulus)
        free = [(5e-3, p * modulus / study.SHEAR_MODULUS, 0.3) for p in PRESSURES]
        worlds = []
        controls = []
        for wall, pressure, height in [*free, (2.2e-3, 1.2 * modulus, 0.09)]:
            params, trial = grasps.hand_world(
                the_scene, length=0.1, height=20e-3, wall=wall, pressure=pressure
            )
            fields, _ = grasps.world_inputs(the_scene, params, trial)
            start = np.array(fields.start)
            start[2] = height
            ctrl = np.append(start[:6], [pressure] * the_scene.num_fingers)
            worlds.append((params, fields._replace(start=start)))
            controls.append(np.repeat(ctrl[None], STEPS, 0))
        many = grasps.stack(*(fields for _, fields in worlds))
        ctrl = np.stack(controls)
        path = oracles.path(StructuredEngine(the_scene), many, ctrl)
        audit = energy.audit(the_scene, many, ctrl, energy.Path(path.qpos, path.qvel))
        angles = path.qpos[:, :, model.layout(the_scene).dofs]
        return Simulated(
            the_scene, [p for p, _ in worlds], angles, audit.rise() / audit.stored.max(1)
        )


def test_free_fingers_rest_where_the_law_has_no_moment(simulated):
    """And where elements have none, within twice the law's residual of moments, 6 %."""
    elements = study.read(DATA / "section.npz")
    [column] = [
        c
        for n, (s, c) in elements.items()
        if n.startswith("nominal") and (s.wall, s.height, s.width) == (5e-3, 20e-3, 24e-3)
    ]
    for world, pressure in enumerate(PRESSURES):
        rest = simulated.angles[world, -1, :, :, 0].sum(-1)
        law = morphology.section_bends(simulated.scene.hand, simulated.params[world])
        # What is left of the swing after two seconds
        np.testing.assert_allclose(rest, law, rtol=1e-3)
        free = (column["pressure"] == pressure) & (np.abs(column["moment_bend"]) < 1e-6)
        np.testing.assert_allclose(rest / 0.1, column["bend"][free].mean(), rtol=0.12)


def test_a_thin_finger_that_is_held_straight_twists_and_stays_finite(simulated):
    """Its law is unstable there, and the step is not."""
    [*_, thin] = simulated.params
    assert morphology.twists_by_itself(simulated.scene.hand, thin).all()
    twist = simulated.angles[-1, ..., 2]
    assert np.isfinite(simulated.angles).all()
    assert 0.1 < np.abs(twist).max() < 3.0


def test_nothing_gains_energy(simulated):
    """Beyond the work of chambers and arm; the bound is that of `test_energy`."""
    assert simulated.rise.max() < 0.01, simulated.rise


GROWING = SETTINGS | {
    "effects__section_growth": True,
    "effects__finger_finger": True,
    "effects__finger_palm": True,
    "effects__finger_itself": True,
    "effects__friction_memory": True,
    **grasps.off("palm_object palm_table"),  # whose rings are as wide as a finger
}


@pytest.fixture(scope="module")
def grown():
    """Worlds whose fingers press on a box, the table, one another and the palm; pressures stay."""
    starts = (3, 0.6, 0.07), (3, 0.8, 0.08), (1, 0.3, 0.09), (5, 1.3, 0.25)
    with jax.enable_x64(True):
        the_scene = grasps.pinch("box", **GROWING)
        worlds = []
        controls = []
        for seed, bend, height in starts:
            fields, qpos, qvel, ctrl = curled_hands.state(the_scene, seed, bend, height)
            worlds.append(fields._replace(start=np.concatenate([qpos, qvel])))
            controls.append(np.repeat(ctrl[None], 60, 0))
        return the_scene, grasps.stack(*worlds), np.stack(controls)


def recorded(the_scene, fields, ctrl):
    engine = StructuredEngine(the_scene).recording()
    with jax.enable_x64(True):
        return grasps.nth(jax.jit(engine.rollout)(fields, ctrl), ...)


def built_larger(fields, pressure):
    """Fields of hands with sections as large as pressure makes them, of the same mass and springs.

    Args:
      pressure: Of the chambers [Pa], shape (world, finger).
    """
    assert fields.growth is not None
    growth = section_growth.Growth(*np.moveaxis(fields.growth[:, :, 0], -1, 0))
    height, width = section_growth.factors(growth, pressure)
    ones = np.ones_like(height)
    section = fields.section * np.stack([height, ones, ones, width], -1)
    return keeping(fields._replace(section=section))


def keeping(fields):
    """The same with sections that grow by nothing."""
    assert fields.growth is not None
    return fields._replace(growth=0 * fields.growth)


def test_sections_that_grow_touch_as_hands_that_are_built_larger(grown):
    """At steady pressures: contact forces of the fingers, and motion."""
    the_scene, fields, ctrl = grown
    larger = built_larger(fields, ctrl[:, 0, 6:])
    every = jax.tree.map(lambda *v: np.concatenate(v), fields, larger, keeping(fields))
    trace = recorded(the_scene, every, np.tile(ctrl, (3, 1, 1)))
    mine, theirs, plain = (
        grasps.nth(trace, part) for part in np.split(np.arange(len(trace.last)), 3)
    )
    # Rounding of sizes, 1e-16, that contacts multiply step by step; forces are up to 50 N.
    np.testing.assert_allclose(mine.last, theirs.last, rtol=1e-6, atol=1e-8)
    for name in ("finger", "finger_table", "finger_finger", "finger_palm"):
        grows, built, keeps = (getattr(t.forces, name) for t in (mine, theirs, plain))
        np.testing.assert_allclose(grows, built, atol=1e-6, err_msg=name)
        assert np.abs(grows - keeps).max() > 0.1, name


# A kernel more, which other tests of rings have; quick: numbers of one kernel, above.
@pytest.mark.slow
def test_sections_that_grow_by_nothing_touch_as_without_the_effect(grown):
    the_scene, fields, ctrl = grown
    still = grasps.pinch("box", **GROWING | {"effects__section_growth": False})
    mine = recorded(the_scene, keeping(fields), ctrl)
    plain = recorded(still, fields._replace(growth=None, first_pressure=None), ctrl)
    # Two kernels round differently; forces are up to 50 N.
    np.testing.assert_allclose(mine.last, plain.last, rtol=1e-6, atol=1e-8)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, atol=1e-6), mine.forces, plain.forces
    )


@pytest.mark.slow  # two kernels; quick: forces are those of hands that are built larger
def test_sections_that_grow_gain_no_energy(grown, monkeypatch):
    """They push what they touch: that is work of the chambers, which the audit has to know."""
    the_scene, fields, ctrl = grown
    rising = ctrl.copy()
    rising[:, :, 6:] *= np.interp(np.arange(60), [30, 59], [0.3, 1.0])[:, None]
    with jax.enable_x64(True):
        engine = StructuredEngine(the_scene)
        run = jax.jit(functools.partial(engine.states, trajectory=True))
        series = run(fields, rising)[1]
        path = energy.Path(*(series[n] for n in energy.Path._fields))
        known = energy.audit(the_scene, fields, rising, path)
        monkeypatch.setattr(energy, "sections_grow", lambda _: False)
        unknown = energy.audit(the_scene, fields, rising, path)
    # While pressures rise: before that, contacts that begin deep are pushed apart.
    rises = [audit.rise(first=30) / audit.stored.max(1) for audit in (known, unknown)]
    assert rises[0].max() < 0.01 and rises[1].max() > 0.1, rises


def test_a_crossed_winding_is_stiffer_and_a_single_one_twists():
    fields = []
    for winding in ("crossed", "single"):
        the_scene = grasps.pinch(**LAW, section__winding=winding)
        params, trial = grasps.hand_world(the_scene)
        fields.append(grasps.world_inputs(the_scene, params, trial)[0])
    twist = the_scene.effects and model.joint_axes(the_scene).index("twist")
    crossed, single = (f.stiffness[..., twist] for f in fields)
    assert (crossed > 1.3 * single).all()
    angles = np.zeros((*single.shape, 3))
    pressure = np.full(len(single), 50e3)
    moments, *_ = model.section_springs(the_scene, grasps.nth(fields[1], ...), angles, pressure)
    assert (np.abs(moments[..., twist]) > 1e-4).all()


# MJX takes a minute to compile; quick: the engine of MuJoCo C, which calls the same function.
@pytest.mark.parametrize("name", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_engines_of_mujoco_bend_fingers_alike(name):
    """Half a second of fingers that fill with air, by the engine and by its step's oracle."""
    settings = grasps.hurried(0.1, 0.2, 0.3, 0.4, 0.45) | LAW
    the_scene = grasps.pinch("sphere", links=1, **settings, phases__deflate_time=0.02)
    world = grasps.hand_world(the_scene, pressure=30e3)
    many, ctrl = grasps.repeat(grasps.world_inputs(the_scene, *world), 1)
    engines = make_engine(name, the_scene), StructuredEngine(the_scene)
    trace, ours = (
        jax.jit(functools.partial(engine.rollout, trajectory=True))(many, ctrl)
        for engine in engines
    )
    assert np.abs(ours.qpos[0, :, model.layout(the_scene).dofs[..., 0]]).max() > 0.2
    np.testing.assert_allclose(trace.qpos, ours.qpos, atol=1e-3)


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"effects__neo_hookean": False}, "effects.neo_hookean"),
        ({"effects__lateral_threshold": True}, "effects.lateral_threshold"),
        ({"effects__air_mass": True}, "effects.air_mass"),
    ],
)
def test_effects_that_the_law_has_or_cannot_have_are_refused(settings, key):
    assert refusal(grasps.pinch, **LAW | settings) == [("conflict", key)]


def test_growth_is_refused_with_chambers_that_keep_their_section():
    settings = {"effects__air_mass": True, "effects__section_growth": True}
    assert refusal(grasps.pinch, **settings) == [("unsupported", "effects.air_mass")]


@pytest.mark.parametrize(
    ("settings", "kind", "key"),
    [
        ({"section__law": "beam"}, "unknown", "hand.section.law"),
        ({"section__winding": "twice"}, "unknown", "hand.section.winding"),
        ({"section__thread_depth": 1.5}, "range", "hand.section.thread_depth"),
    ],
)
def test_bad_keys_of_a_section(settings, kind, key):
    assert refusal(grasps.pinch, **settings) == [(kind, key)]


def test_a_warning_names_fingers_that_twist_by_themselves():
    """Before a simulation, of thin fingers alone and where the law has that."""
    thin = np.array([2.2e-3, 6e-3])
    told = []
    for law in ("elements", "chamber"):
        the_scene = grasps.pinch(**LAW | {"section__law": law})
        pressure = 1.2 * float(the_scene.hand.material.shear_modulus)
        params, _ = grasps.hand_world(the_scene, length=0.1, wall=thin, pressure=pressure)
        told.append(preflight.warnings(the_scene, grasps.repeat(params, 1), ["design"]))
    named = [[line for line in lines if "finger 0 twists" in line] for lines in told]
    assert [len(lines) for lines in named] == [1, 0]
    assert not [line for line in told[0] if "finger 1 twists" in line]
