"""Effects of a scene: as in MuJoCo C, inert without a stimulus, not in the program if off."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from codesign_jax import control, model
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.engines.structured import StructuredEngine, coordinates
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import effects, schema
from codesign_jax.types import WARNINGS
from tests.helpers import grasps, oracles
from tests.helpers.effect_settings import setting

# Compiling takes longer than all that is done with a program here.
QUICK = {"xla_backend_optimization_level": 0}
CONTACTS = ("finger_object", "finger_table", "palm_object", "palm_table", "object_table")
slow = pytest.mark.slow
# The pinch with each object; away from it some effects together, for speed.
SETTINGS = {
    **{shape: {} for shape in grasps.SHAPES},
    "new models": {
        **{"friction": "full", "wrist": False, "neo_hookean": True},
        # A box with an inertia of its own that falls from an edge.
        "objects__object.0.orientation": (20.0, 0.0, 0.0),
        "objects__object.0.inertia": (5e-5, 8e-5, 1.1e-4),
    },
    "little": {"friction": "none", "twist": False, "palm_table": False, "gravity": False},
    "no contact": dict.fromkeys(CONTACTS, False),
}
TOGETHER = ("new models", "little")


@pytest.mark.parametrize(
    "name", [n if n in TOGETHER else pytest.param(n, marks=slow) for n in SETTINGS]
)
def test_steps_equal_mujocos(name):
    """Accelerations of every step of the kernel's own path, contacts included."""
    with jax.enable_x64(True):
        shape = name if name in grasps.SHAPES else "box"
        scene, _, fields, ctrl = setting(SETTINGS[name], shape)
        engine = StructuredEngine(scene, iterations=100, evaluations=40, tolerance=1e-24)
        fields, ctrl = jax.tree.map(lambda x: jnp.asarray(x)[None], fields), ctrl[None, :420]
        found = oracles.path(engine, fields, ctrl)
    errors, far, touching = oracles.against_mujoco(scene, fields, ctrl, found)
    # A difference of velocities over 10 ms loses two of 16 digits, and MuJoCo's own Newton stops at
    # rounding of its cost.  Its rigid arm gives way by the hand's forces over 1e9 kg, which stiff
    # fingers multiply: 1.6e-8 with a wrist of 1e9, 2e-10 of 1e11.
    assert errors.max() < (1e-8 if scene.effects.wrist else 1e-7) and far.max() < 1e-12
    if scene.effects.finger_object and scene.effects.object_table:
        # More than the object on the table.
        assert touching.max() > (1 if shape == "sphere" else 4)


@slow  # half a minute each to compile; quick: whole grasps by stock MJX (test_engines)
@pytest.mark.parametrize("on", [{}, {"friction": "full", "neo_hookean": True}])
def test_mjx_steps_equal_mujocos(on):
    """Stock MJX with the models that it has, on a sphere (its other contacts differ a little)."""
    with jax.enable_x64(True):
        scene, oracle, fields, ctrl = setting(on, "sphere")
        solver = dataclasses.replace(
            scene.solver, tolerance=1e-14, iterations=100, ls_iterations=50
        )
        scene = dataclasses.replace(scene, solver=solver)
        engine = make_engine("mjx", scene)
        step = jax.jit(engine.step, compiler_options=QUICK)
        data, ours = mujoco.MjData(oracle), engine.reset(fields)
        data.qpos[:] = fields.start
        for k in range(420):
            data.ctrl[:] = ctrl[k]
            oracles.soften(scene, fields, data)
            if k % 70 == 20:
                ours = ours.replace(qpos=data.qpos.copy(), qvel=data.qvel.copy())
                found = step(fields, ours, ctrl[k])
                mujoco.mj_forward(oracle, data)
                scale = max(np.linalg.norm(data.qacc), 100.0)
                # MJX keeps its warm start where it is good enough: 4e-9 at rest.
                assert np.linalg.norm(found.qacc - data.qacc) / scale < 1e-7, k
            mujoco.mj_step(oracle, data)


# --- without a stimulus --------------------------------------------------------------------------


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


def primitives(jaxpr, found):
    """Counts the primitives of a jaxpr and all its parts."""
    for equation in jaxpr.eqns:
        found[equation.primitive.name] = found.get(equation.primitive.name, 0) + 1
        for value in jax.tree.leaves(equation.params, is_leaf=lambda v: hasattr(v, "eqns")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                primitives(inner, found)
    return found


def test_without_contacts_the_kernel_has_no_cone():
    """A beam simulation and a falling body: no contact is found, kept, or evaluated."""
    scene = effects_scene(dict.fromkeys(CONTACTS, False))
    assert not Program(scene, Limits(8, 8, 1e-6)).sets
    free = primitives(step_jaxpr(scene), {})
    touching = primitives(step_jaxpr(effects_scene({})), {})
    # A contact is evaluated on condition that it touches, and a cone divides by its forces.  Of all
    # primitives 61 % are left, the fingers' dynamics and the Newton solver's loop.
    assert "cond" not in free and touching["cond"] > 0
    assert free["div"] < touching["div"] / 4
    assert sum(free.values()) < 0.7 * sum(touching.values())


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
            assert "while" in primitives(step_jaxpr(scene), {})


OPTIONS = {"deadline": None, "derandomize": True, "phases": [Phase.generate]}


@settings(max_examples=2, **OPTIONS)
@given(values=COMBINATIONS, shape=st.sampled_from(grasps.SHAPES))
def test_a_combination_builds_or_is_refused(values, shape):
    check_combination(values, shape)


def test_mujoco_s_rigid_arm_moves_fingers_whatever_the_object_does():
    """Fingers that touch nothing: the same motion with the object at rest and falling.

    A solver that starts from the last step's accelerations left the tips 7 mm off, as the cost of
    the palm's 1e9 kg hides what the fingers' accelerations lack.
    """
    off = ("wrist", "finger_object", "finger_table", "palm_object", "palm_table")
    paths = []
    for rests in (True, False):
        effects = {f"effects__{name}": False for name in (*off, "disturb", "ungrasp")}
        scene = grasps.pinch(
            "sphere", links=2, effects__object_table=rests, limits__penetration=0.1, **effects
        )
        params, trials = grasps.random_worlds(scene, 0, 1)
        fields, ctrl = grasps.batch_inputs(scene, params, trials)
        pressed = ctrl[:, 210:222].at[:, :, 2].set(fields.start[0, 2])  # Pa, the arm at rest
        trace = jax.jit(MujocoEngine(scene).rollout, static_argnames="trajectory")(
            fields, pressed, trajectory=True
        )
        assert not (trace.status & ~int(WARNINGS)).any() and np.isfinite(trace.speed).all()
        paths.append(np.asarray(trace.qpos[0, :, 6:-7]))
    assert np.abs(paths[0]).max() > 0.05  # rad: they bend
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-6)
