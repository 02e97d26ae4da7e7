"""Effects of a scene: as in MuJoCo C, inert without a stimulus, not in the program if off."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from codesign_jax import control, model
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import effects, schema
from tests.helpers import grasps

slow = pytest.mark.slow

# --- off is absent -------------------------------------------------------------------------------

# Constants that only these effects read.
CONSTANTS = {
    "wrist": ("hand.wrist", "linear_stiffness", 777.0),
    "finger_table": ("contact", "finger_table_friction", 0.31),
    "object_table": ("objects.table", "friction", 0.29),
    "friction": ("contact", "torsional_friction", 0.017),
    "disturb": ("arm", "shake_amplitude", 13.0),
    "pressure_dynamics": ("pneumatics", "lag", 0.3),
    "air_mass": ("pneumatics", "exponent", 1.3),
    "gravity": ("", "gravity", 1.6),
}
OFF = {
    "wrist": False,
    "finger_table": False,
    "palm_table": False,
    "object_table": False,
    "friction": "coulomb",
    "disturb": False,
    "pressure_dynamics": False,
    "air_mass": False,
    "gravity": False,
}


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
    scene = effects_scene(OFF | {name: "full" if name == "friction" else True})
    assert program(changed(scene, *CONSTANTS[name])) != program(scene)


# --- support -------------------------------------------------------------------------------------


def test_every_effect_is_in_the_table():
    names = [f.name for f in dataclasses.fields(grasps.pinch().effects)]
    assert list(effects.EFFECTS) == names
    for effect in effects.EFFECTS.values():
        assert set(effect.refused) <= set(effects.ENGINES)


def test_unsupported_effect_names_itself_and_the_engine():
    scene = effects_scene({"wrist": False})
    with pytest.raises(schema.InputError, match="engine mjx: effects.wrist = false .*float64"):
        make_engine("mjx", scene)
    assert effects.state(scene.effects, "wrist", "mjx") == "unsupported (false)"
    assert effects.state(scene.effects, "wrist", "mujoco") == "off"
    assert effects.state(scene.effects, "friction", "mujoco") == "coulomb"


def values_of(field):
    return st.sampled_from(field.metadata.get("options", (True, False)))


COMBINATIONS = st.fixed_dictionaries(
    {f.name: values_of(f) for f in dataclasses.fields(grasps.pinch().effects)}
)


def check_combination(values, shape):
    """Every engine takes a step that is finite, or traces one, or says what it cannot do.

    The hull has no friction with torsion and rolling, and the threshold of sideways bending needs
    that hinge and pressures that are known beforehand.
    """
    chosen = {f"effects__{k}": v for k, v in values.items()}
    if values["surface"] == "hull" and values["friction"] == "full":
        with pytest.raises(schema.InputError, match="effects.surface = 'hull' needs friction"):
            grasps.pinch(shape, links=1, **chosen)
        return
    if values["lateral_threshold"] and not values["lateral_bending"]:
        with pytest.raises(schema.InputError, match="lateral_bending = false leaves out"):
            grasps.pinch(shape, links=1, **chosen)
        return
    if values["lateral_threshold"] and values["air_mass"]:
        with pytest.raises(schema.InputError, match="air_mass = true has a volume"):
            grasps.pinch(shape, links=1, **chosen)
        return
    scene = grasps.pinch(shape, links=1, **chosen)
    for name in effects.ENGINES:
        refused = effects.refusals(scene.effects, name)
        if refused:
            with pytest.raises(schema.InputError) as caught:
                make_engine(name, scene)
            assert len(caught.value.problems) == len(refused)
            assert all(f"engine {name}: effects." in p for p in caught.value.problems)
            continue
        engine = make_engine(name, scene)
        if name == "mujoco":
            world, trial = (grasps.stack(v) for v in grasps.hand_world(scene))
            fields, ctrl = grasps.batch_inputs(scene, world, trial)
            trace = engine.rollout(fields, ctrl[:, :2])
            assert np.isfinite(trace.speed).all() and np.isfinite(trace.distance).all()
        elif name == "structured":
            assert "while" in str(step_jaxpr(scene))


OPTIONS = {"deadline": None, "derandomize": True, "phases": [Phase.generate]}


@settings(max_examples=2, **OPTIONS)
@given(values=COMBINATIONS, shape=st.sampled_from(grasps.SHAPES))
def test_a_combination_builds_or_is_refused(values, shape):
    check_combination(values, shape)
