"""Numbers of a scene are data, its effects are structure: what compiles, and what is refused."""

import copy
import dataclasses
import pickle
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from codesign_jax import control, model, rollout, scene
from codesign_jax.commands import common, flags
from codesign_jax.compiler import launch
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.laws.step_numbers import (
    STEP_NUMBERS,
    StepNumber,
    pushed,
)
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import constants, effects, scene_files
from tests.helpers import grasps
from tests.helpers.grasps import hand_world, hurried, off, pinch, random_constants
from tests.helpers.refusals import refusal

# Compiling takes longer than all that is done with a program here.
QUICK = {"xla_backend_optimization_level": 0}
# 30 steps, with every phase
SHORT = hurried(0.1, 0.15, 0.2, 0.25, 0.3) | {"phases__deflate_time": 0.02}
BARE = off("palm_object palm_table finger_table twist")


def short(**settings):
    return pinch("sphere", links=2, **SHORT, **settings)


def named(tree):
    """Leaves of a pytree by key."""
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in pairs}


def with_leaf(tree, key, change):
    """The pytree with one leaf changed."""
    flat, structure = jax.tree_util.tree_flatten_with_path(tree)
    keys = [jax.tree_util.keystr(path).lstrip(".") for path, _ in flat]
    assert key in keys
    leaves = [change(v) if k == key else v for k, (_, v) in zip(keys, flat, strict=True)]
    return jax.tree.unflatten(structure, leaves)


def in_float32(constants):
    """Arrays of one type: JAX traces again for another, and for Python's floats."""
    return jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), constants)


def as_file(other):
    """A scene as files with these numbers give it; names and descriptions differ as well."""
    other = jax.tree.map(float, other)
    return dataclasses.replace(other, name="other", hand=dataclasses.replace(other.hand, name="x"))


def test_every_number_is_a_leaf_with_the_name_of_its_key():
    """All numbers of the three files, but those that say how much is compiled."""
    constants = scene.load("paper_spheres")
    assert constants.hand.material.shear_modulus == 56e3
    assert constants.contact.friction_ratio == 3.0
    assert constants.objects.object[0].mass == 0.1
    keys = set(named(constants))
    assert {"gravity", "hand.finger[3].tilt", "objects.object[1].size[0]"} <= keys
    tables = {key.split(".")[0] for key in keys}
    assert not tables & {"discretization", "solver", "newton", "effects"}
    assert "phases.ungrasp" not in keys


def test_scenes_that_differ_in_numbers_share_their_structure():
    the_scene = short()
    other = as_file(random_constants(the_scene, 1))
    assert other != the_scene and other.structure == the_scene.structure
    assert model.compile_template(other) is model.compile_template(the_scene)
    assert model.layout(other) is model.layout(the_scene)
    assert the_scene.structure.structure == the_scene.structure
    for more in (short(discretization__timestep=0.005), pinch("box", links=2, **SHORT)):
        assert more.structure != the_scene.structure
    with pytest.raises(TypeError, match="unhashable"):
        hash(in_float32(the_scene))


def test_changing_any_number_compiles_nothing(monkeypatch):
    """Neither XLA's program nor the kernel, for a number of each table and for all at once."""
    the_scene = short(**BARE)
    compiled = []
    engine = make_engine("structured", the_scene)
    original = launch.describe

    def counting(inputs, outputs, kernel):
        compiled.append(kernel.origin)
        return original(inputs, outputs, kernel)

    monkeypatch.setattr(launch, "describe", counting)
    world = in_float32(hand_world(the_scene))
    params, trials = jax.tree.map(lambda v: jnp.broadcast_to(v, (2, *v.shape)), world)
    trials = trials._replace(shape=jnp.zeros(2, jnp.int32))

    @partial(jax.jit, compiler_options=QUICK)
    def height(other):
        outcome, trace = rollout.simulate(other, engine, params, trials)
        return trace.height[:, -1], outcome.cost

    constants = in_float32(the_scene)
    first = height(constants)
    # One number of each table alone, then all of them.
    for key in sorted({key.rsplit(".", 1)[0]: key for key in named(constants)}.values()):
        height(with_leaf(constants, key, lambda v: v * 1.01 + 1e-3))
    other = in_float32(random_constants(the_scene, 3))
    changed = height(other)
    assert height._cache_size() == 1 and len(compiled) == 1
    # The numbers act: by a thousandth, of heights that are rounded to 1e-7.
    assert not np.allclose(first[0], changed[0], rtol=1e-4)
    # A scene read from other files asks for the same kernel.
    again = as_file(other)
    other_engine = make_engine("structured", again)
    jax.eval_shape(lambda: rollout.simulate(again, other_engine, params, trials))
    assert len(compiled) == 2 and len(set(compiled)) == 1


@pytest.mark.slow  # 7 s
def test_derivatives_equal_differences():
    """Of every number that the engine reads, with respect to all constants, along a line."""
    the_scene = short(effects__neo_hookean=True)
    random = np.random.default_rng(0)
    with jax.enable_x64(True):
        params, trial = jax.tree.map(jnp.asarray, hand_world(the_scene))
        start = jax.tree.map(jnp.asarray, random_constants(the_scene, 7))
        # Each number moves by a share of its range, that is of its own size.
        way = jax.tree.map(lambda v: v * random.uniform(-1, 1), start)

        def numbers(c):
            fields = model.model_fields(c, params, trial)
            hand = world_constants(the_scene, jax.tree.map(lambda v: v[None], fields))
            leaves = [x for x in jax.tree.leaves((fields, hand)) if x.dtype == float and x.size]
            return jnp.concatenate([x.ravel() for x in leaves])

        size = jnp.abs(jax.jit(numbers, compiler_options=QUICK)(start)) + 1e-6

        def total(c):
            return jnp.sum(numbers(c) / size)

        slopes = jax.jit(jax.grad(total), compiler_options=QUICK)(start)
        total = jax.jit(total, compiler_options=QUICK)
        assert all(np.isfinite(v) for v in jax.tree.leaves(slopes))
        products = jax.tree.map(lambda a, b: a * b, slopes, way)
        # A central difference's error is of order h^2, and of 1e-16 / 1e-6 / h by rounding, in each
        # of some 700 numbers, whose slopes partly cancel.
        h = 1e-4
        ends = [total(jax.tree.map(lambda v, w, s=s: v + s * h * w, start, way)) for s in (1, -1)]
        derivative = sum(jax.tree.leaves(products))
        np.testing.assert_allclose(derivative, (ends[0] - ends[1]) / (2 * h), rtol=1e-5)


def test_later_noise_leaves_earlier_draws_alone():
    """Friction, stiffness and the hand's masses have keys of their own; their factors are 1."""
    key = jax.random.key(3)
    names = ("friction", "stiffness", "hand_mass")
    noise = {"objects.noise": dict(zip(names, (0.3, 0.1, 0.2), strict=True))}
    plain, noisy = (
        jax.device_get(rollout.sample_trials(scene.load("paper_spheres", overrides=o), key, 5))
        for o in ({}, noise)
    )
    drawn = np.array([np.log(getattr(noisy, name)) for name in names])
    assert np.unique(np.abs(drawn)).size == 15
    for name, value in noisy._asdict().items():
        if name in names:
            assert (getattr(plain, name) == 1).all(), name
        else:
            np.testing.assert_array_equal(value, getattr(plain, name), err_msg=name)


DRAWN = """
[[constant]]
key = "hand.material.shear_modulus"
distribution = "lognormal"
mean = 90e3
sd = 0.2
source = "a test"

[[constant]]
key = "hand.material.damping_time"
distribution = "normal"
mean = 5e-3
sd = 4e-4
correlation = [-0.8]
source = "a test"

[[constant]]
key = "objects.object.friction"
distribution = "uniform"
change = "factor"
low = 0.8
high = 1.1
source = "a test"

[[constant]]
key = "hand.finger.1.tilt"
distribution = "normal"
change = "shift"
mean = 0.0
sd = 2.0
source = "a test"
"""
"""A constant of each kind."""


def with_draws(folder, text=DRAWN, **overrides):
    """A scene as --constants has it."""
    path = folder / "constants.toml"
    path.write_text(text)
    options = flags.TrialFlags(constants=str(path))
    return scene.load("paper_spheres", overrides=common.changes(options) | overrides)


def test_every_trial_has_constants_of_its_own(tmp_path):
    """The fields of a trial are those of a scene with its numbers; the middle is the scene's."""
    drawing = with_draws(tmp_path)
    assert drawing.hand.material.shear_modulus == 90e3
    key = jax.random.key(1)
    trials = rollout.sample_trials(drawing, key, 400)
    plain = rollout.sample_trials(scene.load("paper_spheres"), key, 400)
    np.testing.assert_array_equal(trials.mass, plain.mass)
    later = rollout.sample_trials(drawing, key, 2, 7)
    np.testing.assert_array_equal(later.constants, trials.constants[7:9])
    factor, shift, friction, tilt = np.asarray(trials.constants, float).T
    # Standard errors of 400 draws: 3.5 % of a deviation, 5 % of it of a mean.
    assert np.log(factor).std() == pytest.approx(0.2, rel=0.12)
    assert shift.std() == pytest.approx(4e-4, rel=0.12) and tilt.std() == pytest.approx(2, rel=0.12)
    assert np.corrcoef(np.log(factor), shift)[0, 1] == pytest.approx(-0.8, abs=0.08)
    assert 0.8 <= friction.min() and friction.max() <= 1.1
    trial = jax.tree.map(lambda v: v[0], trials)
    trial_scene = jax.jit(constants.with_trial)(drawing, trial)
    assert trial_scene.hand.material.shear_modulus == pytest.approx(90e3 * factor[0])
    assert trial_scene.hand.material.damping_time == pytest.approx(5e-3 + shift[0])
    tilts = [
        b.tilt - a.tilt for a, b in zip(drawing.hand.finger, trial_scene.hand.finger, strict=True)
    ]
    np.testing.assert_allclose(tilts, [0, tilt[0], 0, 0], rtol=1e-5)
    ratios = [
        b.friction / a.friction
        for a, b in zip(drawing.objects.object, trial_scene.objects.object, strict=True)
    ]
    np.testing.assert_allclose(ratios, friction[0], rtol=1e-6)
    assert trial_scene.objects.table.friction == drawing.objects.table.friction


def test_tables_of_other_numbers_share_their_programs(tmp_path):
    """And a scene is written with its table, and read as it was."""
    drawing = with_draws(tmp_path)
    other = with_draws(tmp_path, DRAWN.replace("sd = 0.2", "sd = 0.1"))
    assert drawing.structure == other.structure != scene.load("paper_spheres").structure
    scene_files.write_scene(drawing, tmp_path / "run")
    again = scene.load(tmp_path / "run" / "scene.toml")
    assert again.drawn == drawing.drawn
    left = common.changes(flags.TrialFlags(constants="none"))
    assert scene.load(tmp_path / "run" / "scene.toml", overrides=left).drawn.constant == ()


NO_TABLES = {
    'key = "hand.material.shear_modulus"': (
        'key = "hand.material.modulus"',
        ("unknown", "hand.material.modulus"),
    ),
    'key = "hand.finger.1.tilt"': (
        'key = "objects.object.friction"',
        ("conflict", "constants.toml.constant objects.object.friction"),
    ),
    'key = "objects.object.friction"': ('key = "phases.lift"', ("unknown", "constants")),
    "correlation = [-0.8]": (
        "correlation = [0.1, 0.2]",
        ("size", "constants.toml.constant hand.material.damping_time"),
    ),
    "sd = 0.2": ("sd = -0.2", ("range", "constants.toml.constant[0].sd")),
    "low = 0.8": ("low = 1.2", ("order", "constants.toml.constant objects.object.friction")),
    "mean = 90e3": ("mean = 0.0", ("range", "constants.toml.constant hand.material.shear_modulus")),
    "sd = 2.0": ("low = 1.0", ("conflict", "constants.toml.constant hand.finger.1.tilt")),
}


@pytest.mark.parametrize("right", NO_TABLES)
def test_a_table_that_is_none_is_refused(right, tmp_path):
    wrong, why = NO_TABLES[right]
    assert why in refusal(with_draws, tmp_path, DRAWN.replace(right, wrong))
    law = 'law = "linear"\n' + DRAWN
    told = refusal(with_draws, tmp_path, law, **{"hand.material.law": "neo_hookean"})
    assert ("conflict", "paper_spheres.toml") in told


BAD = [
    (("range", "scene.contact.friction_ratio"), {"contact.friction_ratio": np.nan}),
    (("range", "scene.hand.palm.mass"), {"hand.palm.mass": 250.0}),
    (("size", "scene.objects.object[0].mass"), {"objects.object[0].mass": np.ones((2, 2))}),
    (("order", "scene.phases.inflate"), {"phases.inflate": 0.05}),
]


@pytest.mark.parametrize(("kind", "change"), BAD)
def test_bad_numbers_are_named_before_anything_runs(kind, change):
    [(key, value)] = change.items()
    assert kind in refusal(constants.check, with_leaf(short(), key, lambda _: value))


NOT_OF_A_FILE = [
    (("range", "scene.gravity"), lambda s: ("gravity", -9.81)),
    (("type", "scene.gravity"), lambda s: ("gravity", "3.7")),
    (("range", "scene.gravity"), lambda s: ("gravity", np.float32("nan"))),
    (("range", "scene.gravity"), lambda s: ("gravity", np.array([1.0, -1.0]))),
    (("range", "scene.gravity"), lambda s: ("gravity", jnp.float32(200))),
    (("range", "material.shear_modulus"), lambda s: (
        "hand", dataclasses.replace(s.hand.material, shear_modulus=60)
    )),
    (("range", "finger.base[1]"), lambda s: (
        "hand", dataclasses.replace(s.hand.finger[0], base=(0.0, 36.0), radius=None)
    )),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "change"), NOT_OF_A_FILE)
def test_what_a_file_is_refused_no_scene_is_made_of(kind, change):
    def made():
        name, value = change(short())
        dataclasses.replace(short(), **{name: value})

    assert refusal(made) == [kind]


def test_what_is_not_known_and_what_jax_makes_is_let_pass():
    """Tracers, trees of anything, a float32 of a bound; and a tree has all of its scene."""
    the_scene = short()
    for value in (np.float32(100.0), jnp.zeros(3), 3):
        assert dataclasses.replace(the_scene, gravity=value).gravity is value
    way = jax.tree.map(lambda v: -1e9, the_scene)
    assert way.hand.material.shear_modulus == -1e9 and way.num_steps == the_scene.num_steps

    def weigh(gravity):
        return dataclasses.replace(the_scene, gravity=gravity).gravity

    assert float(jax.jit(jax.grad(weigh))(-1.0)) == 1.0
    again = jax.tree.unflatten(*reversed(jax.tree.flatten(the_scene)))
    assert again == the_scene and hash(again) == hash(the_scene)
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(the_scene)]
    assert ".hand.material.shear_modulus" in map(jax.tree_util.keystr, paths)
    assert copy.deepcopy(the_scene) == pickle.loads(pickle.dumps(the_scene)) == the_scene


# --- effects: inert without a stimulus, not in the program if off, refused in words ---------------


slow = pytest.mark.slow


# Constants that only these effects read.
CONSTANTS = {
    "wrist": ("hand.wrist", "linear_stiffness", 777.0),
    "finger_table": ("contact", "finger_table_friction", 0.31),
    "object_table": ("objects.table", "friction", 0.29),
    "disturb": ("arm", "shake_amplitude", 13.0),
    "pressure_dynamics": ("pneumatics", "lag", 0.3),
    "air_mass": ("pneumatics", "exponent", 1.3),
    "gravity": ("", "gravity", 1.6),
}
OFF = dict.fromkeys([*CONSTANTS, "palm_table"], False) | {"friction": "coulomb"}


def changed(value, path, field, new):
    """A scene with one number changed."""
    if not path:
        return dataclasses.replace(value, **{field: new})
    head, _, rest = path.partition(".")
    inner = changed(getattr(value, head), rest, field, new)
    return dataclasses.replace(value, **{head: inner})


def program(scene):
    """Text of everything a grasp computes: the kernel's arguments, and the kernel of a step."""
    world, trial = (jax.tree.map(jnp.asarray, grasps.stack(v)) for v in grasps.hand_world(scene))
    kernel = Program(scene, Limits(8, 8, 1e-6), width=8)

    def run(p, t):
        fields = jax.vmap(lambda p, t: model.model_fields(scene, p, t))(p, t)
        ctrl = jax.vmap(lambda p, t: control.commands(scene, p, t))(p, t)
        return kernel.inputs(world_constants(scene, fields), coordinates.reset(scene, fields), ctrl)

    return jax.jit(run).lower(world, trial).as_text() + str(step_jaxpr(scene))


def step_jaxpr(scene):
    """The jaxpr of the kernel of one step."""
    shapes = [grasps.stack(v) for v in grasps.hand_world(scene)]
    fields = jax.eval_shape(jax.vmap(lambda p, t: model.model_fields(scene, p, t)), *shapes)
    hand = jax.eval_shape(lambda f: world_constants(scene, f), fields)
    state = jax.eval_shape(lambda f: coordinates.reset(scene, f), fields)
    ctrl = jax.ShapeDtypeStruct((1, 1, 6 + scene.num_fingers), fields.start.dtype)
    return Program(scene, Limits(8, 8, 1e-6), width=8).jaxpr(hand, state, ctrl)


def effects_scene(values, **settings):
    return grasps.pinch(links=2, **{f"effects__{k}": v for k, v in values.items()}, **settings)


@pytest.fixture(scope="module")
def bare():
    """A scene without the effects of OFF, and its program."""
    scene = effects_scene(OFF)
    return scene, program(scene)


def test_an_effect_that_is_off_is_not_in_the_program(bare):
    """With every constant of these effects changed, the program is the same."""
    scene, text = bare
    for name in CONSTANTS:
        scene = changed(scene, *CONSTANTS[name])
    assert scene != bare[0]
    assert program(scene) == text


@pytest.mark.parametrize(
    "name", [n if n == "wrist" else pytest.param(n, marks=slow) for n in CONSTANTS]
)
def test_an_effect_that_is_on_is_in_the_program(name):
    """The same comparison fails for every effect that is on."""
    scene = effects_scene(OFF | {name: True})
    assert program(changed(scene, *CONSTANTS[name])) != program(scene)


def test_every_effect_is_in_the_table():
    names = [f.name for f in dataclasses.fields(grasps.pinch().effects)]
    assert list(effects.EFFECTS) == names
    for effect in effects.EFFECTS.values():
        assert set(effect.refused) <= set(effects.ENGINES)


def test_unsupported_effect_names_itself_and_the_engine():
    scene = effects_scene({"wrist": False})
    assert [kind for kind, _ in refusal(make_engine, "mjx", scene)] == ["unsupported"]
    assert effects.state(scene.effects, "wrist", "mjx") == "unsupported (false)"
    assert effects.state(scene.effects, "wrist", "mujoco") == "off"
    assert effects.state(scene.effects, "friction", "mujoco") == "coulomb"


COMBINATIONS = st.fixed_dictionaries(
    {
        f.name: st.sampled_from(f.metadata.get("options", (True, False)))
        for f in dataclasses.fields(grasps.pinch().effects)
    }
)
# The threshold of sideways bending needs that hinge, and pressures that are known beforehand.
REFUSED = {
    "lateral_threshold": {"lateral_threshold": True, "lateral_bending": False},
    "air_mass": {"lateral_threshold": True, "air_mass": True},
}


@settings(max_examples=2, deadline=None, derandomize=True, phases=[Phase.generate])
@given(values=COMBINATIONS, shape=st.sampled_from(grasps.SHAPES))
def test_a_combination_builds_or_is_refused(values, shape):
    """Every engine takes a step that is finite, or traces one, or says what it cannot do."""
    chosen = {f"effects__{k}": v for k, v in values.items()}
    for effect, wrong in REFUSED.items():
        if wrong.items() <= values.items():
            told = refusal(grasps.pinch, shape, links=1, **chosen)
            assert ("unsupported", f"effects.{effect}") in told
            return
    scene = grasps.pinch(shape, links=1, **chosen)
    for name in effects.ENGINES:
        refused = effects.refusals(scene.effects, name)
        if refused:
            told = refusal(make_engine, name, scene)
            assert [kind for kind, _ in told] == ["unsupported"] * len(refused)
            continue
        engine = make_engine(name, scene)
        if name == "mujoco":
            world, trial = (grasps.stack(v) for v in grasps.hand_world(scene))
            fields, ctrl = grasps.batch_inputs(scene, world, trial)
            trace = engine.rollout(fields, ctrl[:, :2])
            assert np.isfinite(trace.speed).all() and np.isfinite(trace.distance).all()
        elif name == "structured":
            assert "while" in str(step_jaxpr(scene))


def test_a_number_of_a_step_may_bring_a_force_along(monkeypatch):
    """At the centre of mass of the bodies that it names: a wrench about the object's centre."""

    def force(number, mass):
        return mass * jnp.stack([number, 0 * number, 0 * number])

    wind = StepNumber(lambda scene: 2.0, lambda effects: True, force=force, bodies=("object",))
    monkeypatch.setitem(STEP_NUMBERS, "wind", wind)
    centre = np.array([0.1, 0.2, 0.3])
    pushing = {"wind": jnp.asarray(2.0)}
    wrench = pushed("object", jnp.ones(6), 0.5, jnp.asarray(centre), pushing)
    expected = [*np.cross(centre, [1.0, 0.0, 0.0]), 1.0, 0.0, 0.0]
    np.testing.assert_allclose(wrench - 1.0, expected, atol=1e-6)  # float32
    for body, numbers in (("palm", pushing), ("object", {})):
        same = pushed(body, jnp.ones(6), 0.5, jnp.asarray(centre), numbers)
        np.testing.assert_array_equal(same, 1.0)
