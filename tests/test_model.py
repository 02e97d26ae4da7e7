"""Model fields against fresh compiles, and implicit springs against MuJoCo's own integrator."""

import dataclasses
import operator
from functools import partial

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import model, rollout, scene
from tests.helpers.grasps import DATA, hand_world, nth, off, pinch, random_constants, random_worlds

# Arrays of mjModel that differ between hands although no ModelFields entry carries them, and why
# nothing in these scenes reads them.
UNREAD = {
    "qpos0": "hinges and slides start at 0; the object's entry only serves mj_resetData",
    "qpos_spring": "differs at the free joint only, which has no spring",
    "dof_invweight0": "scales joint limits, joint friction and equalities: there are none",
    "tendon_invweight0": "scales tendon limits and friction: there are none",
    "actuator_acc0": "read by muscles only",
    "dof_length": "read by sleeping only, which is off",
}
# Rows of model fields that may differ from a fresh compile, since nothing reads them either.
READ_ROWS = {
    "body_pos": slice(-1),  # the object's pose comes from its free joint
    "body_quat": slice(-1),
    "dof_M0": slice(-6, None),  # only free bodies take their inertia from it: the object
}
# Fields with sines and cosines of angles up to a turn, whose rounding is an absolute one.
ROUNDED = {"body_pos": 1e-16, "body_quat": 1e-15}


def arrays(compiled):
    """Every array of an mjModel by name."""
    names = (n for n in dir(compiled) if not n.startswith("_"))
    values = {n: getattr(compiled, n) for n in names}
    return {n: v for n, v in values.items() if isinstance(v, np.ndarray)}


SCENES = {
    "tripod3, two spheres": lambda: scene.load(
        "paper_spheres",
        hand_name="tripod3",
        overrides={
            "discretization": {"links": 4, "spheres_per_link": 2},
            "objects.object.1": {"orientation": [90, 0, 10], "inertia": [5e-5, 3e-5, 6e-5]},
        },
    ),
    "tapered": lambda: scene.load("paper_spheres", hand_name=DATA / "tapered.toml"),
}


@pytest.fixture(
    params=["tripod3, two spheres", pytest.param("tapered", marks=pytest.mark.slow)],
    scope="module",
)
def worlds(request):
    """A scene with fields of six random worlds in float64 and their fresh compiles.

    In each world all numbers of scene, hand and objects are others, and the trial has factors on
    friction, stiffness and the hand's masses.
    """
    the_scene = SCENES[request.param]()

    with jax.enable_x64(True):
        params, trials = random_worlds(the_scene, seed=1, count=6)
        others = random_constants(the_scene, seed=2, count=6)
        others = dataclasses.replace(others, objects=noisy(others.objects))
        trials = rollout.sample_trials(others, jax.random.key(1), 6)
        fields = jax.jit(jax.vmap(model.model_fields))(others, params, trials)
        fresh = [model.compile_model(*nth((others, params, trials), i)) for i in range(6)]
    return the_scene, nth(fields, slice(None)), fresh, (params, trials, others)


def noisy(objects):
    """Numbers of an object set with noise of friction, stiffness and the hand's masses."""
    ones = np.ones_like(objects.noise.position)
    noise = {"friction": 0.3 * ones, "stiffness": 0.2 * ones, "hand_mass": 0.2 * ones}
    return dataclasses.replace(objects, noise=dataclasses.replace(objects.noise, **noise))


def test_fields_equal_a_fresh_compile(worlds):
    """To a few units in the last place: the compiler evaluates the same formulas in its order."""
    the_scene, fields, fresh, _ = worlds
    with jax.enable_x64(True):
        of_worlds = jax.jit(jax.vmap(partial(model.mujoco_fields, the_scene.structure)))
        written = jax.tree.map(np.asarray, of_worlds(fields))
    for i, compiled in enumerate(fresh):
        for name, value in nth(written, i).of_model.items():
            expected = np.asarray(operator.attrgetter(name)(compiled))
            assert value.shape == expected.shape and value.dtype == np.float64
            rows = READ_ROWS.get(name, slice(None))
            # Entries span 1e-8 to 1e4 within an array, so the bound is relative to each entry; the
            # absolute one is for exact zeros.
            np.testing.assert_allclose(
                np.atleast_1d(value)[rows],
                np.atleast_1d(expected)[rows],
                rtol=1e-14,
                atol=ROUNDED.get(name, 1e-18),
                err_msg=name,
            )
        # Object and palm as MuJoCo would place them; fingers straight.
        rest = nth(fields, i).start[-7:]
        np.testing.assert_allclose(rest, compiled.qpos0[-7:], rtol=1e-14, atol=1e-18)
        np.testing.assert_array_equal(nth(fields, i).start[6:-7], 0.0)


def test_every_array_that_depends_on_the_hand_is_covered(worlds):
    """What differs between fresh compiles of worlds is a model field or is known to be unread."""
    fresh = worlds[2]
    first = arrays(fresh[0])
    differing = {
        n for c in fresh[1:] for n, v in arrays(c).items() if not np.array_equal(v, first[n])
    }
    assert differing <= set(model.MujocoFields._fields) | set(UNREAD)


def test_no_part_reads_the_unread_constants(worlds):
    """What UNREAD claims: no limits, joint friction, equalities, muscles or sleeping."""
    compiled = worlds[2][0]
    assert (
        compiled.neq == 0 and not compiled.jnt_limited.any() and not compiled.tendon_limited.any()
    )
    assert not compiled.dof_frictionloss.any() and not compiled.tendon_frictionloss.any()
    assert not (compiled.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE).any()
    assert not (compiled.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP)
    free = compiled.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    assert not compiled.jnt_stiffness[free].any()
    assert not compiled.tendon_stiffness.any() and not compiled.tendon_damping.any()
    np.testing.assert_array_equal(np.flatnonzero(compiled.body_simple), [0, compiled.nbody - 1])


def discrete_twin(the_scene, params, trial):
    """The model with physical springs and dampers under MuJoCo's own implicit integrator."""
    m = model.compile_model(the_scene, params, trial)
    with jax.enable_x64(True):
        stiffness, damping = nth(model.joint_springs(the_scene, params), slice(None))
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    m.dof_damping[:] = damping
    m.dof_armature[:] = 0.0
    return m, stiffness


def test_implicit_springs_equal_mujocos_discrete_integrator():
    """Without contact, every step of a second of inflation under gravity and a moving arm.

    The twin's wrist springs are passive too: position actuators are not implicit in MuJoCo.
    """
    the_scene = pinch("sphere", 5, **off("finger_object finger_table palm_object palm_table"))
    params, trial = hand_world(the_scene)
    ours = model.compile_model(the_scene, params, trial)
    twin, stiffness = discrete_twin(the_scene, params, trial)
    twin.jnt_stiffness[:6] = stiffness[:6]
    twin.actuator_gainprm[:6, 0] = twin.actuator_biasprm[:6, 1] = 0.0
    data = mujoco.MjData(ours)
    other = mujoco.MjData(twin)
    worst = 0.0
    for step in range(100):
        target = np.array([0.0, 0.01, 0.02, 0.1, 0.0, 0.3]) * step / 100
        data.ctrl[:6] = target
        data.ctrl[6:] = 1200.0 * step
        other.ctrl[:] = data.ctrl
        other.qfrc_applied[:6] = stiffness[:6] * target
        for name in ("qpos", "qvel"):
            getattr(other, name)[:] = getattr(data, name)
        mujoco.mj_step(ours, data)
        mujoco.mj_step(twin, other)
        # The object falls on the table in both; only the hand is compared.
        worst = max(worst, np.abs(data.qacc[:-6] - other.qacc[:-6]).max())
    assert np.abs(data.qpos[6:-7]).max() > 0.05  # it did bend
    # Accelerations of up to 10 rad/s^2 to rounding, with the condition of M (measured 3e-13).
    assert worst < 1e-11


def test_every_kind_of_pair_has_its_own_numbers():
    """By the names of what touches, with a number of its own for each kind."""
    values = {
        "contact__finger_table_friction": 0.31,
        "contact__finger_finger_friction": 0.41,
        "contact__finger_palm_friction": 0.51,
        "contact__finger_palm_stiffness": 5000.0,
    }
    on = {f"effects__{name}": True for name in ("finger_finger", "finger_palm", "palm_object")}
    the_scene = pinch("capsule", links=4, **on, **values)
    compiled = model.compile_model(the_scene, *hand_world(the_scene))
    want = {
        ("object", "table"): the_scene.objects.table.friction,
        ("finger", "object"): the_scene.objects.object[0].friction,
        ("object", "palm"): the_scene.objects.object[0].friction,
        ("finger", "table"): 0.31,
        ("palm", "table"): 0.31,
        ("finger", "finger"): 0.41,
        ("finger", "palm"): 0.51,
    }
    c = the_scene.contact
    kinds = set()
    for i in range(compiled.npair):
        pair = compiled.pair_geom1[i], compiled.pair_geom2[i]
        kind = tuple(sorted(compiled.geom(g).name.split("_")[0] for g in pair))
        np.testing.assert_allclose(compiled.pair_friction[i, :2], want[kind], rtol=1e-12)
        stiffness = 5000.0 if kind == ("finger", "palm") else c.normal_stiffness
        d = compiled.pair_solimp[i, 0]
        h = the_scene.discretization.timestep
        mass = d / (1 - d) / (2 * model.contact_invweight(the_scene))
        expected = stiffness * h * (h + max(c.dissipation_time, 1.5 * h))
        np.testing.assert_allclose(mass, expected, rtol=1e-9)
        # MuJoCo divides by d^2 and multiplies by d.
        spring, damper = -compiled.pair_solref[i] / d
        np.testing.assert_allclose([spring * mass, damper * h], [stiffness, 1.0], rtol=1e-9)
        kinds.add(kind)
    assert kinds == set(want)
