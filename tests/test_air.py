"""Air in the chambers, and pressure against sideways bending: closed forms, MuJoCo C, faults."""

import dataclasses
import functools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import integrate, optimize

from codesign_jax import model, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import chambers
from codesign_jax.engines.structured.laws import air
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import morphology
from codesign_jax.model.layout import NEWMARK
from codesign_jax.scene import schema
from tests.helpers import grasps
from tests.helpers.curled_hands import batched, curled
from tests.helpers.planted_faults import Fault, planted, simulate

BOUND = 1e-8
"""As in test_steps.py."""
WANTED = 60e3
ATMOSPHERE = 101325.0


def test_power_is_numpy_s():
    """To sixteen times rounding, by which the last four squarings multiply it."""
    base = np.geomspace(0.05, 20, 500)
    exponent = np.linspace(1, 1.7, 8)[:, None]
    power = jax.jit(air.power)
    powers = power(jnp.float32(base), jnp.float32(exponent))
    np.testing.assert_allclose(powers, base**exponent, rtol=4e-6)
    with jax.enable_x64(True):
        powers = power(jnp.asarray(base), exponent)
    np.testing.assert_allclose(powers, base**exponent, rtol=1e-13)


def root(function):
    """An angle [rad]."""
    return float(optimize.brentq(function, -2, 9, xtol=1e-14))  # pyright: ignore[reportArgumentType]


class Finger:
    """A finger of one joint in the plane in which it bends; everything from its section."""

    def __init__(self, the_scene, params, exponent, neo_hookean=False):
        """Takes its dimensions; SI units."""
        length, height, wall = (float(v[0]) for v in (params.length, params.height, params.wall))
        width = the_scene.hand.section.width
        shear = the_scene.hand.material.shear_modulus
        area = (width - 2 * wall) * (height - 2 * wall)
        self.gain = area * height / 2
        self.straight = area * length
        self.exponent = exponent
        second = width * height**3 - (width - 2 * wall) * ((height - wall) ** 3 - wall**3)
        self.stiffness = 4 * shear * second / 3 / length

        def carried(angle):
            share = morphology.softening(np.float64(angle) / length, height, wall, width=width)
            return self.stiffness * angle * (1 - neo_hookean * share)

        self.free = root(lambda q: carried(q) - self.gain * WANTED)

    def volume(self, angle):
        return self.straight + self.gain * angle

    def pressure(self, angle):
        """Gauge pressure of the air that has the wanted one in the free finger."""
        ratio = self.volume(self.free) / self.volume(angle)
        return (WANTED + ATMOSPHERE) * ratio**self.exponent - ATMOSPHERE

    def energy(self, angle):
        """Of the wall, and of air and atmosphere, isothermal."""
        volume = self.volume(angle)
        mass = (WANTED + ATMOSPHERE) * self.volume(self.free)
        wall = self.stiffness * angle**2 / 2
        return wall, ATMOSPHERE * volume - mass * np.log(volume / self.straight)


@pytest.mark.parametrize("neo_hookean", [False, True])
def test_a_free_finger_has_the_wanted_pressure(neo_hookean):
    with jax.enable_x64(True):
        overrides = {"effects__neo_hookean": neo_hookean, "pneumatics__exponent": 1.4}
        the_scene = grasps.pinch("sphere", links=1, effects__air_mass=True, **overrides)
        params, trial = grasps.hand_world(the_scene, wall=0.003, length=0.1)
        fields, ctrl = grasps.world_inputs(the_scene, params, trial)
        hand = grasps.lanes(the_scene, grasps.repeat(fields, 1))
        controls = np.array(ctrl)[None, :1]
        controls[..., 6:] = WANTED
        mine = Finger(the_scene, params, 1.4, neo_hookean)

        @jax.jit
        def reached(hand, controls, grown):
            charge = chambers.charged(the_scene, hand, controls)[0, 0, 6]
            arguments = hand.volume[0, 0], hand.air[:, 0, 0], (grown, 0.0, 0.0)
            return air.end_pressure(1.0, charge, *arguments)

        pressure, fall = reached(hand, controls, mine.gain * mine.free)
    assert pressure == pytest.approx(WANTED, rel=1e-9)
    ends = (mine.pressure(mine.free + a) for a in (1e-6, -1e-6))
    slope = np.subtract(*ends) / (2e-6 * mine.gain)
    assert fall == pytest.approx(-slope, rel=1e-6)  # of central differences


BARE = "finger_object finger_table palm_object palm_table object_table wrist"
BARE += " twist lateral_bending disturb"


@functools.cache
def swung():
    """Scene, parameters, fields, and angles and speeds (world, time) of a finger of one joint.

    In the first world it is heavy and damped, in the second one weightless, undamped and bent
    further than at rest.
    """
    overrides = {"effects__air_mass": True, "discretization__timestep": 1e-3}
    plain = grasps.pinch("sphere", links=1, **overrides, **grasps.off(BARE))
    with jax.enable_x64(True):
        params, trial = grasps.hand_world(plain, wall=0.003, length=0.1)
        worlds = []
        for gravity, damping, start in ((100.0, 0.05, 0.0), (0.0, 0.0, 2.0)):
            heavy = {"damping_time": damping, "density": 10000.0}
            material = dataclasses.replace(plain.hand.material, **heavy)
            hand = dataclasses.replace(plain.hand, material=material)
            the_scene = dataclasses.replace(plain, hand=hand, gravity=gravity)
            fields, ctrl = grasps.world_inputs(the_scene, params, trial)
            begun = np.array(fields.start)
            begun[6] = start
            worlds.append(fields._replace(start=begun))
        fields = grasps.stack(*worlds)
        controls = np.repeat(np.array(ctrl)[None, :1], 1000, 1)
        controls[..., 6:] = WANTED
        engine = StructuredEngine(plain, tolerance=1e-24)

        @jax.jit
        def run(fields, ctrl):
            return engine.advance(world_constants(plain, fields), engine.reset(fields), ctrl)[0]

        outputs = run(fields, np.repeat(controls, 2, 0))
    return plain, params, fields, *(np.asarray(outputs[n])[..., 6] for n in ("qpos", "qvel"))


def test_a_loaded_finger_rests_where_the_closed_form_does():
    """The torque of its weight, by MuJoCo C, against wall and air: a root of one variable."""
    the_scene, params, fields, angles, speeds = swung()
    mine = Finger(the_scene, params, 1.0)
    oracle = world_model(the_scene, grasps.nth(fields, 0))
    data = mujoco.MjData(oracle)

    def unbalanced(angle, pressure):
        data.qpos[:] = fields.start[0]
        data.qpos[6] = angle
        mujoco.mj_forward(oracle, data)
        return mine.stiffness * angle - mine.gain * pressure + data.qfrc_bias[6]

    rest, ideal = (
        root(lambda q, p=p: unbalanced(q, p(q))) for p in (mine.pressure, lambda q: WANTED)
    )
    # A second is 20 times the damping time of 50 ms; mass and air leave 1e-7 of the motion.
    assert angles[0, -1] == pytest.approx(rest, abs=1e-6)
    assert abs(rest - ideal) > 0.05


def test_a_free_swing_keeps_its_energy():
    """Of wall, air, atmosphere and motion, less what implicit Euler takes, to the third order."""
    the_scene, params, fields, angles, speeds = swung()
    mine = Finger(the_scene, params, 1.0)
    oracle = world_model(the_scene, grasps.nth(fields, 1))
    data = mujoco.MjData(oracle)
    mass = np.zeros((oracle.nv, oracle.nv))
    data.qpos[:] = fields.start[1]
    mujoco.mj_forward(oracle, data)
    mujoco.mj_fullM(oracle, data, mass)
    inertia = mass[6, 6] - oracle.dof_armature[6]
    q = angles[1]
    v = speeds[1]
    wall, gas = mine.energy(q)
    fall = (mine.pressure(q) + ATMOSPHERE) / mine.volume(q)
    turned = np.diff(q)
    faster = np.diff(v)
    lost = inertia * faster**2 + (mine.stiffness + fall[:-1] * mine.gain**2) * turned**2
    total = wall + gas + inertia * v**2 / 2
    left = total[1:] + np.cumsum(lost) / 2 - total[0]
    # The air's energy to the third order in a step's change of volume: 1e-5 of what is lost.
    assert np.abs(left).max() < 1e-4 * (total[0] - total[-1])
    assert np.ptp(gas) > 0.5 * np.ptp(wall) and np.count_nonzero(np.diff(np.sign(v))) > 8


def stored(the_scene, params, pressure, bend, lateral):
    """Energy of a length of the first finger [J/m] by quadrature over its section.

    Walls of modulus 4 G in plane strain, and the chamber's volume times the pressure.  The fibre
    at height y and z has the strain that leaves the one bottom edge as long as it is: the left one
    or the right one, by the sign of the lateral curvature.
    """
    width = the_scene.hand.section.width
    shear = the_scene.hand.material.shear_modulus
    height = float(params.height[0])
    wall = float(params.wall[0])

    def strain(y, z):
        return bend * y - abs(lateral) * width / 2 + lateral * z

    def over(y0, y1, half, value):
        return integrate.dblquad(lambda z, y: value(y, z), y0, y1, -half, half, epsrel=1e-12)[0]

    chamber = wall, height - wall, width / 2 - wall
    energy = over(0, height, width / 2, lambda y, z: strain(y, z) ** 2)
    energy -= over(*chamber, lambda y, z: strain(y, z) ** 2)
    return 2 * shear * energy - pressure * over(*chamber, strain)


@pytest.mark.parametrize("lateral", [12.0, -12.0])
def test_moments_are_those_of_the_stored_energy(lateral):
    """Virtual work: slopes of the energy by both curvatures, where one edge has let go.

    The smoothing is off by (q_0/q)^2/2, 6e-4 at 12 /m; the energy is quadratic in the curvatures
    on either side, so that central differences are exact.
    """
    with jax.enable_x64(True):
        the_scene = scene.load("paper", overrides={"effects.lateral_threshold": True})
        params, _ = grasps.hand_world(the_scene, length=0.1)
        links = the_scene.discretization.links
        bend = 15.0
        small_step = 0.5
        pressure = 1.7 * the_scene.hand.material.shear_modulus
        beams = morphology.finger_beams(the_scene.hand, params, links)
        numbers = morphology.thresholds(the_scene.hand, params, beams, links)[0, 0]
        beams = jax.tree.map(lambda v: v[:, 0], beams)
        segment = float(params.length[0]) / links
        slopes = [
            (
                stored(the_scene, params, pressure, bend + b, lateral + s)
                - stored(the_scene, params, pressure, bend - b, lateral - s)
            )
            / (2 * small_step)
            for b, s in ((small_step, 0.0), (0.0, small_step))
        ]
        stiffness, moment = morphology.threshold_moments(
            tuple(map(jnp.asarray, numbers)),
            pressure,
            jnp.asarray(bend * segment),
            jnp.asarray(lateral * segment),
        )
        # As in `beam`, without the calibrated factor on the lateral spring.
        lateral_spring = beams.lateral[0] / the_scene.hand.material.lateral_factor
        mine = (
            beams.bending[0] * bend - pressure * beams.moment_per_pressure[0] - moment,
            lateral_spring * lateral + stiffness * lateral * segment,
        )
        # The smoothed length lacks q_0.
        mine = float(mine[0] - numbers[1] * numbers[2]), float(mine[1])
        assert float(stiffness) * abs(lateral) * segment > 0.01 and float(moment) > 1e-3
    np.testing.assert_allclose(mine, slopes, rtol=1e-3)


def numbers_of(*factors):
    """Other numbers of the threshold."""

    def stage(right, the_scene, parent, constants, joint):
        numbers = constants["threshold"]
        scale = jnp.asarray(factors).reshape(-1, *[1] * (numbers.ndim - 1))
        return right(the_scene, parent, constants | {"threshold": scale * numbers}, joint)

    return Fault({"link_forces": stage})


def explicit(right, the_scene, parent, constants, joint):
    carry, numbers = right(the_scene, parent, constants, joint)
    return carry, numbers | {"armature_now": constants["armature"]}


FAULTS = {
    "air": {
        "air is isothermal": Fault(
            {
                "end_pressure": lambda right, h, c, v, a, g: right(
                    h, c, v, jnp.stack([a[0] / 1.4, a[1]]), g
                )
            }
        ),
        "the pressure of a step is that of its start": Fault(
            {"end_pressure": lambda right, h, *arguments: right(0 * h, *arguments)}
        ),
        "pressures of a step's end stay": Fault(
            {"Chambers.move.<locals>.push": lambda right, tau, *_: tau}
        ),
    },
    "sideways": {
        "sideways only the walls resist": numbers_of(0.0, 1.0, 1.0),
        "bending does not slacken the layer": numbers_of(1.0, 0.0, 1.0),
        "edges let go late": numbers_of(1.0, 1.0, 2.0),
        "the spring's inertia is left out": Fault({"link_forces": explicit}),
    },
}
SETTINGS = {
    "air": {"effects__air_mass": True, "pneumatics__exponent": 1.4},
    "sideways": {"effects__lateral_threshold": True, "discretization__integrator": "euler"},
    "sideways, by Newmark": {
        "effects__lateral_threshold": True,
        "discretization__integrator": "newmark",
    },
}


def fill(the_scene, model_, data, fields):
    """Gives MuJoCo's tendons, which have the joints' angles as lengths, the air of this state."""
    h = the_scene.discretization.timestep
    lay = model.layout(the_scene)
    n = 1.4
    for f, joints in enumerate(lay.dofs[..., 0]):
        gain = float(fields.gain[0, f, 0])
        height, _, segment, _ = np.asarray(fields.section)[0, f]
        stiffness = model_.jnt_stiffness[joints[0]]
        straight = 4 * gain / height * segment
        pressure = data.ctrl[6 + f]
        volume = straight + gain * data.qpos[joints].sum()
        free = straight + gain * len(joints) * gain * pressure / stiffness
        absolute = (pressure + ATMOSPHERE) * (free / volume) ** n
        fall = n * absolute / volume
        data.ctrl[6 + f] = absolute - ATMOSPHERE - h * fall * gain * data.qvel[joints].sum()
        model_.tendon_armature[f] = h * h * fall * gain**2


def stiffen(the_scene, model_, data, fields):
    """Gives MuJoCo's joints the springs of this state, and the moments on its bend hinges."""
    lay = model.layout(the_scene)
    h = the_scene.discretization.timestep
    angles = data.qpos[lay.dofs]
    for f, j in np.ndindex(*lay.dofs.shape[:2]):
        bend, lateral = lay.dofs[f, j, :2]
        numbers = np.asarray(fields.threshold)[0, f, 0]
        q, s = angles[f, j, :2]
        moment = max(numbers[0] * data.ctrl[6 + f] - numbers[1] * q, 0.0)
        length = np.hypot(s, numbers[2])
        added = moment / length
        model_.jnt_stiffness[lateral] += added
        if the_scene.discretization.integrator == "euler":
            model_.dof_damping[lateral] += h * added
            model_.dof_armature[lateral] += h * h * added
        else:
            model_.dof_armature[lateral] += NEWMARK * h * h * added
        if moment > 0:
            data.qfrc_applied[bend] += numbers[1] * (length - numbers[2])


@functools.cache
def simulated(name):
    """Relative errors of a step's accelerations, of each fault's world and of a sound one."""
    faults = FAULTS.get(name, {})
    with jax.enable_x64(True):
        the_scene = grasps.pinch("sphere", links=2, **SETTINGS[name])
        model_, data, fields = curled(the_scene, 3, 0.4, 0.09)
        fields_, qpos, qvel, ctrl = batched([(model_, data, fields)] * (len(faults) + 1))
        with planted(faults):
            run = jax.jit(partial(simulate, the_scene))
            ctrl = np.repeat(ctrl[:, None], 2, 1)
            outputs = run(fields_, (qpos, qvel), ctrl, np.arange(len(qpos)))
    (fill if name == "air" else stiffen)(the_scene, model_, data, fields)
    mujoco.mj_forward(model_, data)
    assert data.ncon > 3
    acc = (np.asarray(outputs["qvel"])[:, 1] - qvel) / the_scene.discretization.timestep
    return np.linalg.norm(acc - data.qacc, axis=1) / np.linalg.norm(data.qacc)


def slow_but(name, *values):
    """Values of a quick test for the layer on the sides, of a slow one for other kernels.

    Closed forms of the air are quick, above.
    """
    marks = [] if name == "sideways" else [pytest.mark.slow]
    return pytest.param(name, *values, marks=marks)


@pytest.mark.parametrize(
    "name", [slow_but(name) for name in ("air", "sideways", "sideways, by Newmark")]
)
def test_accelerations_equal_mujoco_with_the_chambers_of_the_state(name):
    assert simulated(name)[-1] < BOUND


@pytest.mark.parametrize(
    ("name", "fault"), [slow_but(name, fault) for name in FAULTS for fault in FAULTS[name]]
)
def test_a_planted_fault_is_noticed(name, fault):
    """By a hundred times the bound."""
    assert not simulated(name)[[*FAULTS[name]].index(fault)] < 100 * BOUND


def test_it_is_refused_where_it_is_not_simulated():
    with pytest.raises(schema.InputError, match="effects.air_mass = true has a volume that"):
        grasps.pinch(effects__air_mass=True, effects__lateral_threshold=True)
    with pytest.raises(schema.InputError, match=r"pneumatics.exponent = 0.9 is outside \[1, 1.7\]"):
        grasps.pinch(pneumatics__exponent=0.9)
    for name in ("mujoco", "mjx"):
        with pytest.raises(schema.InputError, match="effects.air_mass = true .* engine structured"):
            make_engine(name, grasps.pinch(effects__air_mass=True))
