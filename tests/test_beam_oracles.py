"""One finger: its beam theory, its chain in MuJoCo C and its files, against closed forms.

The finger leaves a palm on a stiff wrist horizontally.  Statics come from stepping until nothing
moves: the implicit springs damp, and the fixed point of a step is the static solution.  Loads and
positions are taken in the palm's frame, so that the wrist's remaining compliance does not matter.
"""

import dataclasses
import functools
import re

import mujoco
import numpy as np
import pytest
from scipy import integrate, linalg, optimize, special

from codesign_jax import cli, finger, model, scene
from codesign_jax.model import morphology
from codesign_jax.scene import hand, keypaths, parameters
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Params, Tip, Trial
from tests.helpers.grasps import off, pinch


@functools.cache
def finger_scene(
    links,
    *,
    bending_only=True,
    gravity=0.0,
    timestep=0.01,
    shear_modulus=70e3,
    beta=6e-3,
    integrator="euler",
):
    without = "finger_object finger_table palm_object palm_table"
    the_scene = pinch(
        "sphere",
        links,
        discretization__timestep=timestep,
        discretization__integrator=integrator,
        **off(without + " lateral_bending twist" * bending_only),
    )
    one = dataclasses.replace(
        the_scene.hand,
        finger=(hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=0.0),),
        wrist=hand.Wrist(1e5, 1e4, 1e3, 1e2),
        material=dataclasses.replace(
            the_scene.hand.material, shear_modulus=shear_modulus, damping_time=beta
        ),
    )
    return dataclasses.replace(the_scene, hand=one, gravity=gravity)


def elastica(load):
    """How far a cantilever's tip moves down and back over L, by a dead load alpha = P L^2 / E I.

    Bisshopp and Drucker (1945).
    """

    def phi(k):
        return np.arcsin(1 / (k * np.sqrt(2)))

    def gap(k):
        return special.ellipk(k**2) - special.ellipkinc(phi(k), k**2) - np.sqrt(load)

    k = float(optimize.brentq(gap, np.sqrt(0.5) + 1e-12, 1 - 1e-12, xtol=1e-15))
    w = 1 - 2 / np.sqrt(load) * (special.ellipe(k**2) - special.ellipeinc(phi(k), k**2))
    u = 1 - np.sqrt(2 * np.sin(np.arcsin(2 * k**2 - 1)) / load)
    return float(w), float(u)


class Finger:
    """MuJoCo's chain of one finger; loads act at the tip's bottom layer."""

    def __init__(self, links, length=0.1, height=0.02, wall=0.005, **options):
        """Compiles the finger of `finger_scene`, 0.3 m above the table; dimensions in m."""
        self.scene = scene = finger_scene(links, **options)
        self.layout = model.layout(scene)
        self.length = length
        self.links = links
        one = np.ones(1)
        zero = np.zeros(())
        params = Params(length * one, height * one, wall * one, zero, np.zeros(6), 0 * one)
        trial = Trial(np.int32(0), np.zeros(2), zero, np.zeros(2), np.ones(()), np.ones(()))
        self.model = model.compile_model(scene, params, trial)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2] = self.data.ctrl[2] = 0.3
        width = scene.hand.section.width
        material = scene.hand.material
        how = {"shear_modulus": material.shear_modulus, "density": material.density}
        self.beam = morphology.beam(height, wall, width=width, **how)

    def tip(self):
        """Position [m], (3,), and orientation, (3, 3), of the tip in the frame of the root."""
        palm, frame = (self.data.xmat[b].reshape(3, 3) for b in (1, self.layout.bodies[0, -1]))
        return palm.T @ (self._end() - self.data.xpos[1]), palm.T @ frame

    def _end(self):
        d = self.data
        last = self.layout.bodies[0, -1]
        return d.xpos[last] + d.xmat[last].reshape(3, 3) @ [self.length / self.links / 2, 0, 0]

    def settle(self, force=(0, 0, 0), torque=(0, 0, 0), pressure=0.0, steps=3000, rest=1e-10):
        """The tip under a load of fixed direction in the palm's frame, at rest to rounding."""
        m = self.model
        d = self.data
        last = self.layout.bodies[0, -1]
        d.ctrl[6] = pressure
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        for _ in range(steps):
            palm = d.xmat[1].reshape(3, 3)
            d.qfrc_applied[:] = 0.0
            load = palm @ force, palm @ torque
            mujoco.mj_applyFT(m, d, *load, self._end(), last, d.qfrc_applied)
            mujoco.mj_step(m, d)
            # The object, last in qvel, falls or rests; it is not what is waited for.
            if d.time > 0.1 and np.abs(d.qvel[:-6]).max() < rest:
                break
        else:
            raise RuntimeError(f"a finger of {self.links} links did not come to rest")
        mujoco.mj_kinematics(m, d)
        return self.tip()


@pytest.mark.parametrize("links", [5, 10, 20, 40])
def test_small_load_cantilever(links):
    """P L^3 / 3 E I, for the midpoint chain times exactly 1 - 1 / (4 N^2); slope P L^2 / 2 E I."""
    finger = Finger(links)
    load = 1e-4 * finger.beam.bending / finger.length**2  # alpha = 1e-4: geometry stays linear
    position, frame = finger.settle(force=(0, 0, -load))
    expected = load * finger.length**3 / (3 * finger.beam.bending)
    # At this load geometric nonlinearity is of order alpha^2 = 1e-8.
    assert -position[2] == pytest.approx(expected * (1 - 1 / (4 * links**2)), rel=1e-6)
    slope = load * finger.length**2 / (2 * finger.beam.bending)
    assert -frame[2, 0] == pytest.approx(slope, rel=1e-6)  # exact for every N: joints average L/2


@pytest.mark.parametrize(
    "alpha, continuum, chain",
    [
        (1, (0.301720770, 0.056433236), (0.300897, 0.056417)),
        (2, (0.493457480, 0.160641720), (0.491924, 0.160531)),
        (10, (0.810609020, 0.554995600), (0.806629, 0.554083)),
    ],
)
def test_elastica(alpha, continuum, chain):
    """Large deflection at ten links: the table of docs/physics.md, recomputed here."""
    np.testing.assert_allclose(elastica(alpha), continuum, atol=5e-9)
    finger = Finger(10, timestep=0.002)  # the dead load's own stiffness is explicit
    load = alpha * finger.beam.bending / finger.length**2
    position, _ = finger.settle(force=(0, 0, -load))
    tip = np.array([-position[2], finger.length - position[0]]) / finger.length
    np.testing.assert_allclose(tip, chain, atol=1e-6)  # the chain's numbers have six digits
    np.testing.assert_allclose(tip, continuum, rtol=5e-3)


@pytest.mark.parametrize("links", [2, 3, 10])
def test_roll_up_under_pressure(links):
    """M = 2 pi E I / L closes the midpoint chain to a circle, tip at root, for every N."""
    finger = Finger(links)
    full = 2 * np.pi * finger.beam.bending / finger.length / finger.beam.moment_per_pressure
    for fraction in (0.1, 0.3, 0.5, 0.7, 0.9):  # not in one step: it would swing through itself
        finger.settle(pressure=fraction * full)
    position, frame = finger.settle(pressure=full)
    np.testing.assert_allclose(position, 0.0, atol=1e-7 * finger.length)
    np.testing.assert_allclose(frame, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("links", [5, 20])
def test_self_weight(links):
    """w L^4 / 8 E I, for the midpoint chain times exactly 1 - 1 / (2 N^2)."""
    finger = Finger(links, length=0.05, gravity=9.81, shear_modulus=1e7)
    weight = finger.beam.line_density * 9.81
    position, _ = finger.settle()
    expected = weight * finger.length**4 / (8 * finger.beam.bending)
    assert expected / finger.length < 1e-4  # a rod of this modulus stays straight
    # The centre of mass lies h / 2 above the layer that carries it: a correction of order sag / L.
    assert -position[2] == pytest.approx(expected * (1 - 1 / (2 * links**2)), rel=2e-4)


@pytest.mark.parametrize("links", [1, 10])
def test_twist(links):
    """T L / G J: the same for every number of links."""
    finger = Finger(links, bending_only=False)
    torque = 0.1 * finger.beam.torsion / finger.length
    _, frame = finger.settle(torque=(torque, 0, 0))
    assert np.arctan2(frame[2, 1], frame[1, 1]) == pytest.approx(0.1, rel=1e-5)


def test_lateral_and_vertical_stiffness_of_the_full_joint():
    """With all three hinges, small loads bend each plane as its own beam."""
    finger = Finger(10, bending_only=False)
    stiffness = np.array([finger.beam.lateral, finger.beam.bending])
    load = 1e-4 * finger.beam.bending / finger.length**2
    position, _ = finger.settle(force=(0, load, load))
    expected = load * finger.length**3 / (3 * stiffness) * (1 - 1 / 400)
    np.testing.assert_allclose(position[1:], expected, rtol=1e-4)


# The Princeton beam as EXUDYN computes it with 16 elements (BSD-3-Clause, TestModels/
# ANCFBeamTest.py): a cantilever of 0.508 m whose section of 12.3777 x 3.2024 mm is at an angle to
# the dead load on its tip.  Load [N], angle [deg], and how far the tip moves along the beam, in its
# strong and in its weak direction [m].  ANSYS, which that file quotes too, differs by 2 % in the
# strong direction.
PRINCETON = (
    (8.896, 0, -0.0001352, -0.0107023, 0.0),
    (8.896, 15, -0.0022414, -0.0106295, 0.0421374),
    (8.896, 30, -0.0076567, -0.0101861, 0.0794434),
    (8.896, 45, -0.0143664, -0.0089529, 0.1089703),
    (8.896, 60, -0.0204225, -0.0067182, 0.1297877),
    (8.896, 75, -0.0245093, -0.0036079, 0.1420319),
    (8.896, 90, -0.0259403, 0.0, 0.1460608),
    (13.345, 0, -0.0003039, -0.0160454, 0.0),
    (13.345, 15, -0.005319, -0.0165469, 0.064622),
    (13.345, 30, -0.0171901, -0.0169316, 0.1179818),
    (13.345, 45, -0.0303357, -0.0155488, 0.1565214),
    (13.345, 60, -0.0411035, -0.0118996, 0.1817173),
    (13.345, 75, -0.0479101, -0.0064334, 0.1958343),
    (13.345, 90, -0.0502184, 0.0, 0.2003738),
)


def princeton_rigidity():
    """Weak and strong E I and G J [N m^2]; EXUDYN's torsion factor is 0.198 on both moments."""
    height = 12.3777e-3
    width = 3.2024e-3
    young = 71.7e9
    poisson = 0.31
    weak = height * width**3 / 12
    strong = width * height**3 / 12
    shear = young / 2 / (1 + poisson)
    return np.array([young * weak, young * strong, shear * 0.198 * (weak + strong)])


def balanced(finger, rigidity, force, bend=0.0):
    """Where a dead load holds the tip of MuJoCo's chain [m], the palm fixed.

    Args:
      rigidity: Of bending, sideways bending and twist [N m^2], shape (3,).
      bend: Angle by which a moment on all its joints bends the unloaded finger [rad].
    """
    m = finger.model
    d = finger.data
    last = finger.layout.bodies[0, -1]
    dofs = finger.layout.dofs[0].ravel()
    length = finger.length
    springs = np.tile(rigidity * finger.links / length, finger.links)
    moment = np.tile([rigidity[0] * bend / length, 0.0, 0.0], finger.links)
    unit = np.sqrt(springs)
    jacobian = np.zeros((3, m.nv))

    def residual(y, share):
        d.qpos[dofs] = y / unit
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_jac(m, d, jacobian, None, finger._end(), last)
        return y - share * (moment + force @ jacobian[:, dofs]) / unit

    y = np.zeros(dofs.size)
    for share in (0.25, 0.5, 0.75, 1.0):  # from rest to rest
        y = optimize.root(residual, y, args=(share,), tol=1e-10).x
        assert np.abs(residual(y, share)).max() < 1e-8
    return finger.tip()[0]


@pytest.mark.parametrize(
    "links, far, aside", [(10, 1.2e-3, 0.03), (20, 6e-4, 0.004)], ids=["10 links", "20 links"]
)
def test_princeton_beam(links, far, aside):
    """A beam that bends both ways and twists, by any share of each.

    The tip is at most `far` of the length off, and its strong deflection, which the weak one turns
    away, by the share `aside`: 0.100 and 0.047 % of the length, 2.5 and 0.22 %.  With hinges in the
    same order in all joints they are 0.375 and 0.164 %, 8.9 and 4.4 % at 45 degrees.
    """
    finger = Finger(links, length=0.508, bending_only=False)
    for load, angle, *expected in PRINCETON:
        turn = np.deg2rad(angle)
        force = load * np.array([0.0, -np.cos(turn), np.sin(turn)])
        moved = balanced(finger, princeton_rigidity(), force) - [finger.length, 0.0, 0.0]
        np.testing.assert_allclose(moved, expected, atol=far * finger.length)
        assert moved[1] == pytest.approx(expected[1], rel=aside, abs=1e-9)


@pytest.mark.parametrize("bend, load", [(60, 0.3), (120, 0.3), (180, 0.3), (120, 1.0)])
def test_a_bent_finger_gives_way_sideways(bend, load):
    """Ten links of a finger as in the paper's hand, against forty: 0.9 to 1.2 % less.

    With hinges in the same order in all joints ten links lack 4 to 8 %.
    """
    rigidity = np.array([6.8e-3, 5.1e-3, 1.75e-3])
    force = np.array([0.0, load, 0.0])
    turn = np.deg2rad(bend)
    ten, fine = (
        balanced(Finger(n, bending_only=False), rigidity, force, turn)[1] for n in (10, 40)
    )
    assert ten == pytest.approx(fine, rel=0.02)


def eigenfrequencies(finger):
    """Angular frequencies of the finger on a fixed palm, from MuJoCo's mass matrix, ascending."""
    m = finger.model
    dofs = finger.layout.dofs.ravel()
    finger.data.qpos[6 + np.arange(dofs.size)] = 0.0
    mujoco.mj_forward(m, finger.data)
    mass = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, finger.data, mass)
    mass -= np.diag(m.dof_armature)
    stiffness = np.diag(m.jnt_stiffness[dofs])
    values, vectors = linalg.eigh(stiffness, mass[np.ix_(dofs, dofs)])
    return np.sqrt(values), vectors


@pytest.mark.parametrize(
    "integrator, beta, acts",
    [("euler", 6e-3, 7e-3), ("newmark", 6e-3, 6e-3), ("newmark", 5e-4, 5e-4)],
)
def test_ring_down(integrator, beta, acts):
    """Log decrement 2 pi zeta / sqrt(1 - zeta^2) with zeta = omega / 2 times a Kelvin-Voigt time.

    Euler's is beta + h, to first order in h omega, which is 7e-3 here; Newmark's is beta.
    """
    finger = Finger(5, timestep=1e-3, length=0.3, integrator=integrator, beta=beta)
    omega, shape = eigenfrequencies(finger)
    m = finger.model
    d = finger.data
    d.qpos[6:11] = 1e-3 * shape[:, 0] / np.abs(shape[:, 0]).max()
    d.qvel[:] = 0.0
    d.ctrl[2] = d.qpos[2]
    angle = []
    for _ in range(4000):
        angle.append(d.qpos[6])
        mujoco.mj_step(m, d)
    angle = np.array(angle)
    peaks = np.flatnonzero((angle[1:-1] > angle[:-2]) & (angle[1:-1] >= angle[2:])) + 1
    h = 1e-3
    zeta = acts * omega[0] / 2
    period = 2 * np.pi / (omega[0] * np.sqrt(1 - zeta**2))
    assert len(peaks) >= 4
    # Four periods of 0.85 s, peaks at whole steps.
    assert (peaks[3] - peaks[0]) / 3 * h == pytest.approx(period, rel=1e-3)
    decrement = np.log(angle[peaks[0]] / angle[peaks[3]]) / 3
    # Euler's first-order term; Newmark's peaks at whole steps, worth (h omega)^2 / 8.
    assert decrement == pytest.approx(2 * np.pi * zeta / np.sqrt(1 - zeta**2), rel=6e-3)


@pytest.mark.parametrize("integrator, order", [("euler", 1.0), ("newmark", 2.0)])
def test_order_in_time(integrator, order):
    """A mode of the finger against its closed form x(t) = exp(-zeta omega t) cos(...)."""
    errors = []
    for h in (16e-3, 8e-3):
        finger = Finger(5, timestep=h, length=0.3, integrator=integrator)
        omega, shape = eigenfrequencies(finger)
        m = finger.model
        d = finger.data
        decay = 6e-3 * omega[0] ** 2 / 2
        turning = np.sqrt(omega[0] ** 2 - decay**2)

        def angle(t, decay=decay, turning=turning):  # of a start without velocity
            wave = np.cos(turning * t) + decay / turning * np.sin(turning * t)
            return 1e-3 * np.exp(-decay * t) * wave

        d.qpos[6:11] = angle(0.0) * shape[:, 0]
        # Newmark's velocities are those of half a step before.
        before = -h / 2 if integrator == "newmark" else 0.0
        rate = (angle(before + 1e-6) - angle(before - 1e-6)) / 2e-6
        d.qvel[6:11] = rate * shape[:, 0]
        d.ctrl[2] = d.qpos[2]
        worst = 0.0
        for k in range(round(0.8 / h)):
            modal = d.qpos[6:11] @ shape[:, 0] / (shape[:, 0] @ shape[:, 0])
            worst = max(worst, abs(modal - angle(k * h)))
            mujoco.mj_step(m, d)
        errors.append(worst)
    # The next term of Euler's error is a share h omega, 0.12, of the leading one. The palm, which
    # is not quite fixed, is worth 4e-4, a quarter of Newmark's error at 8 ms.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


def test_free_fall():
    """Semi-implicit Euler falls g h^2 n (n + 1) / 2 in n steps, exactly."""
    finger = Finger(1, gravity=9.81)
    m = finger.model
    d = finger.data
    d.qpos[-5] = 2.0
    for _ in range(50):
        mujoco.mj_step(m, d)
    assert 2.0 - d.qpos[-5] == pytest.approx(9.81 * 0.01**2 * 50 * 51 / 2, rel=1e-12)
    assert 2.0 - d.qpos[-5] == pytest.approx(9.81 * 0.5**2 / 2, rel=0.02 + 1e-9)  # h / t


# --- beam theory of a finger against quadrature and closed forms ----------------------------------


def section(height=0.020, wall=0.005, width=0.020, shear_modulus=70e3, density=1070.0):
    """Python floats in, Python floats out: float64 whatever jax's mode."""
    return morphology.beam(height, wall, width=width, shear_modulus=shear_modulus, density=density)


def wall_integral(height, wall, width, weight):
    """Integral of weight(y, z) over the wall, by strips: outer rectangle less chamber."""

    def rectangle(y0, y1, half):
        return integrate.dblquad(lambda z, y: weight(y, z), y0, y1, -half, half, epsabs=1e-16)[0]

    inner = rectangle(wall, height - wall, width / 2 - wall)
    return rectangle(0, height, width / 2) - inner


@pytest.mark.parametrize("height, wall, width", [(0.02, 0.005, 0.02), (0.025, 0.002, 0.024)])
def test_section_integrals(height, wall, width):
    """Area and second moments are the integrals that they stand for; quadrature is exact here.

    Torsion is Bredt's: 4 A^2 d / s of the area A within the wall's middle line of length s.
    """
    beam = section(height, wall, width)
    young = 4 * 70e3
    bending = wall_integral(height, wall, width, lambda y, z: y**2)
    lateral = wall_integral(height, wall, width, lambda y, z: (z + width / 2) ** 2)
    area = wall_integral(height, wall, width, lambda y, z: 1.0)
    assert beam.bending == pytest.approx(young * bending, rel=1e-6)
    assert beam.lateral == pytest.approx(young * lateral, rel=1e-6)
    assert beam.line_density == pytest.approx(1070 * area, rel=1e-6)
    wide = width - wall
    high = height - wall
    assert beam.torsion == pytest.approx(70e3 * 2 * (wide * high) ** 2 * wall / (wide + high))
    chamber = (width - 2 * wall) * (height - 2 * wall)
    assert beam.moment_per_pressure == pytest.approx(chamber * height / 2)


@pytest.mark.parametrize("links", [1, 2, 7])
def test_segments_are_a_finger_cut_in_pieces(links):
    """Mass, centre and inertia about the base of one block as long; its springs in series."""
    hand = scene.load("paper").hand
    params = Params(*np.array([[0.09, 0.13], [0.018, 0.021], [0.004, 0.005]]), 0.0, None, None)
    beams = morphology.finger_beams(hand, params, links)
    found = morphology.segments(hand, params, links)
    length = params.length
    height = params.height
    mass = beams.line_density[:, 0] * params.length
    joint = np.cumsum(found.offset, 1)
    # A joint stands in the middle of each segment.
    np.testing.assert_allclose(joint, np.outer(length, (np.arange(links) + 0.5) / links))
    start = np.concatenate([0 * joint[:, :1], joint], 1)
    np.testing.assert_allclose(start[:, 1:], (start + found.extent)[:, :-1], rtol=1e-12)
    centre = start + found.extent / 2
    np.testing.assert_allclose(found.mass.sum(1), mass)
    np.testing.assert_allclose((found.mass * centre).sum(1), mass * length / 2)
    about = (found.inertia[..., 1] + found.mass * centre**2).sum(1)
    np.testing.assert_allclose(about, mass * (length**2 / 3 + height**2 / 12))
    for name, rigidity in (("bend", "bending"), ("lateral", "lateral"), ("twist", "torsion")):
        stiffness, damping = morphology.joint_springs(hand, params, beams, links, (name,))
        whole = length / getattr(beams, rigidity)[:, 0]
        np.testing.assert_allclose(links / stiffness[:, 0, 0], whole)
        np.testing.assert_allclose(damping, hand.material.damping_time * stiffness)
    spheres = morphology.sphere_places(found.extent, 3)
    assert spheres.shape == (2, links, 3)
    np.testing.assert_allclose(spheres.mean(2), found.extent[:, 1:] / 2)
    np.testing.assert_allclose(np.diff(spheres, axis=2).max(2), found.extent[:, 1:] / 3)


def tapered():
    """Two fingers of the paper's hand whose sections shrink towards the tips."""
    hand = scene.load("paper").hand
    base = Params(*np.array([[0.09, 0.13], [0.022, 0.021], [0.005, 0.004]]), 0.0, None, None)
    tip = Tip(np.array([0.013, 0.016]), np.array([0.003, 0.0035]), np.array([0.016, 0.02]))
    return hand, base._replace(tip=tip)


def test_a_tapered_finger_is_the_integral_of_its_sections():
    """Mass, centre and compliance by SciPy's quadrature over the sections, as links go to many."""
    hand, params = tapered()
    for f in range(2):

        def beam(s, f=f):
            base = np.array([params.height[f], params.wall[f], hand.section.width])
            h, d, w = base + s * (np.array([v[f] for v in params.tip]) - base)
            m = hand.material
            return h, morphology.beam(
                h, d, width=w, shear_modulus=m.shear_modulus, density=m.density
            )

        def integral(weight, f=f):
            return params.length[f] * integrate.quad(weight, 0, 1, epsabs=1e-14)[0]

        mass = integral(lambda s: beam(s)[1].line_density)
        along = integral(lambda s, f=f: params.length[f] * s * beam(s)[1].line_density) / mass
        up = integral(lambda s: beam(s)[0] / 2 * beam(s)[1].line_density) / mass
        bend = integral(lambda s: beam(s)[1].moment_per_pressure / beam(s)[1].bending)
        for links in (1, 3, 10):
            found = morphology.segments(hand, params, links)
            start = np.concatenate([[0], np.cumsum(found.offset[f])])
            assert found.mass[f].sum() == pytest.approx(mass, rel=1e-12)
            centre = start + found.along[f]
            assert (centre * found.mass[f]).sum() / mass == pytest.approx(along, rel=1e-12)
            assert (found.up[f] * found.mass[f]).sum() / mass == pytest.approx(up, rel=1e-12)
            # Midpoints: the error of a joint's angle goes with the square of its segment.
            beams = morphology.finger_beams(hand, params, links)
            springs, _ = morphology.joint_springs(hand, params, beams, links, ("bend",))
            chain = (beams.moment_per_pressure[f] / springs[f, :, 0]).sum()
            assert chain == pytest.approx(bend, rel=0.12 / links**2)
        free = morphology.free_bends(
            hand, params._replace(pressure=np.full(2, 1e5)), neo_hookean=False
        )
        assert free[f] == pytest.approx(1e5 * bend, rel=1e-4)


# --- one finger at rest, its fits and files -------------------------------------------------------


def material(law="linear"):
    """Overrides of law and modulus."""
    return {"hand.material.law": law, "hand.material.shear_modulus": 40e3}


def made(links=10, law="linear"):
    loaded = scene.load("paper", overrides=material(law) | {"discretization.links": links})
    space = parameters.design_space(loaded.hand, "2d")
    design = space.from_units([110.0, 0.0])
    return finger.of_design(loaded, space.params(design), 0)


@pytest.mark.parametrize("links", [3, 10])
def test_closed_forms_of_beams(links):
    """M L / EI; M / L; 3 M / 2 L and P L^3 / 3 EI, both up to the chain's 1 - 1 / (4 N^2)."""
    mine = made(links)
    chain = 1 - 1 / (4 * links**2)
    [stiffness], [gain] = mine.stiffness, mine.gain
    # 1e-3 rad a joint
    moment = 1e-3 * stiffness
    rigidity = stiffness * mine.segment
    pressure = moment / gain
    load = 0.1 * moment / mine.length
    table = {n: np.array([pressure]) for n in ("pressure", *finger.MEASURED)}
    table["load"] = np.array([load])
    found = {n: v.item() for n, v in finger.predict(mine, table).items()}
    assert found["angle"] == pytest.approx(moment * mine.length / rigidity, rel=1e-9)
    assert found["blocked_force"] == pytest.approx(moment / mine.length, rel=1e-12)
    # At these loads geometric nonlinearity is of the square of the angles, 1e-4.
    assert found["tip_force"] == pytest.approx(1.5 * moment / mine.length / chain, rel=1e-3)
    expected = load * mine.length**3 / (3 * rigidity) * chain
    assert found["deflection"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("alpha", [1, 2])
def test_a_large_load_gives_the_elastica(alpha):
    """Bisshopp and Drucker's tip; at 40 links the chain errs by 3e-4 at most."""
    mine = made(40)
    load = alpha * mine.stiffness[0] * mine.segment / mine.length**2
    rest = finger.Rest.of(mine, 0.0, load)
    assert -rest.height / mine.length == pytest.approx(elastica(alpha)[0], rel=3e-4)


def synthetic(truth, noise, seed=0, columns=("angle", "tip_force")):
    """Rows that a finger would give, with noise relative to a column's root mean square."""
    table = {n: np.full(8, np.nan) for n in ("pressure", *columns)}
    table["pressure"] = np.linspace(5e3, 60e3, 8)
    if "deflection" in columns:
        table["load"] = np.full(8, 0.05)
    for name in columns:
        table[name][:] = 0.0
    table |= finger.predict(truth, table)
    random = np.random.default_rng(seed)
    for name in columns:
        size = np.sqrt((table[name] ** 2).mean())
        table[name] = table[name] + noise * size * random.standard_normal(8)
    return table


@pytest.mark.parametrize("columns", [("angle", "tip_force"), ("angle", "deflection")])
def test_a_fit_finds_the_material_within_its_own_error(columns):
    """Over ten draws of noise the errors are as large as it says; such a ratio varies by 22 %."""
    mine = made(3)
    truth = (52e3, 0.8)
    errors = []
    spreads = []
    for seed in range(10):
        table = synthetic(mine.of_material(*truth), 0.02, seed, columns)
        found = finger.fit(mine, table)
        errors.append(np.log(np.divide(found[:2], truth)))
        spreads.append(found.spread)
    ratio = np.sqrt(np.mean(np.square(errors), 0) / np.mean(np.square(spreads), 0))
    assert (ratio > 0.4).all() and (ratio < 1.8).all()


@pytest.mark.parametrize("pressure", [0.0, 20e3, 80e3])
def test_a_free_neo_hookean_finger_is_the_chain_s(pressure):
    mine = made(1, "neo_hookean")
    loaded = scene.load("paper", overrides=material("neo_hookean"))
    space = parameters.design_space(loaded.hand, "2d")
    params = space.params(space.from_units([110.0, 0.0]))
    params = params._replace(pressure=np.full(4, pressure))
    bends = morphology.free_bends(loaded.hand, params, neo_hookean=True)
    np.testing.assert_allclose(bends, finger.Rest.of(mine, pressure).angles.sum(), rtol=1e-6)
    if pressure:
        assert bends[0] > morphology.free_bends(loaded.hand, params, neo_hookean=False)[0]


def test_a_fit_under_the_neo_hookean_law_is_exact_without_noise():
    mine = made(3, "neo_hookean")
    truth = (52e3, 0.8)
    found = finger.fit(mine, synthetic(mine.of_material(*truth), 0.0))
    np.testing.assert_allclose(found[:2], truth, rtol=1e-6)


def test_a_file_is_read_in_its_units(tmp_path):
    path = tmp_path / "finger.csv"
    path.write_text(
        "# mine\npressure_bar, angle_deg,load_mN,deflection_cm\n0.5,90,,\n\n1,,200,1.5\n"
    )
    table = finger.read(path)
    np.testing.assert_allclose(table["pressure"], [50e3, 100e3])
    np.testing.assert_allclose(table["angle"], [np.pi / 2, np.nan])
    np.testing.assert_allclose(table["load"], [np.nan, 0.2])
    np.testing.assert_allclose(table["deflection"], [np.nan, 0.015])


SPELLINGS = {
    "commas": "pressure_kPa,angle_deg\n20,18.9\n40,-37.2\n",
    "semicolons and decimal commas": "pressure_kPa;angle_deg\n20;18,9\n40;-37,2\n",
    "semicolons and points": "pressure_kPa;angle_deg\r\n20;18.9\r\n40;-37.2\r\n",
    "tabs": "pressure_kPa\tangle_deg\n20\t18,9\n40\t-37.2\n",
    "a line for Excel": "\ufeffsep=;\npressure_kPa;angle_deg\n20;18,9\n40;-37,2\n",
    "empty columns": "pressure_kPa;angle_deg;;\n20;18,9;;\n40;-37,2;;\n",
    "a typographic minus": "pressure_kPa,angle_deg\n20,18.9\n40,\N{MINUS SIGN}37.2\n",
    "quotes": 'pressure_kPa,angle_deg\n"20","18.9"\n"40","-37.2"\n',
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_table_is_read_as_spreadsheets_write_it(spelling, tmp_path):
    path = tmp_path / "finger.csv"
    path.write_bytes(SPELLINGS[spelling].encode())
    table = finger.read(path)
    np.testing.assert_allclose(table["pressure"], [20e3, 40e3])
    np.testing.assert_allclose(np.rad2deg(table["angle"]), [18.9, -37.2])


WRONG = {
    "pressure_kPa,angle_deg\n20,18,9": "line 2 has 3 cells, the head 2; beside a decimal comma",
    "pressure_kPa;angle_deg\n20;1.018,9": "line 2, angle_deg = '1.018,9' must be a number",
    "pressure_kPa angle_deg\n20 18.9": "columns are separated by commas, semicolons or tabs",
    'pressure_kPa,angle_deg\n"1,2\n3,4': "line 2 is no row of cells: unexpected end of data",
    "presure_kPa,angle_deg\n1,2": "did you mean 'pressure_kPa'?",
    "pressure_kPa,pressure_Pa,angle_deg\n1,1,2": "column 'pressure' is given more than once",
    "# a\npressure_kPa,angle_deg\n\n1,x": "line 4, angle_deg = 'x' must be a number",
    "pressure_kPa,angle_deg\n-1,2": "a pressure is below 0",
    "pressure_kPa,load_N\n1,2": "no measured value; columns of them: angle, tip_force",
    "pressure_kPa,deflection_mm\n1,2": "a deflection has no load beside it",
    "# nothing": "is empty",
    'pressure_kPa,angle_deg\n"1,2\n3,4\n': "line 2 is no row of cells",
    'pressure_kPa,angle_deg\n"1\n",2\n': "line 2 is no row of cells",
    '"\n1,2\n': "line 1 is no row of cells",
    'pressure_kPa,angle_deg\n"1"2,3\n': "line 2 is no row of cells",
    "pressure_kPa,angle_deg\n" + "1" * 200_000 + ",2\n": "line 2 is no row of cells",
    "# " + "a" * 1_000_000: "more than 1,000,000 characters",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_file_is_refused(text, tmp_path):
    path = tmp_path / "finger.csv"
    path.write_text(text)
    with pytest.raises(InputError, match="finger.csv") as error:
        finger.read(path)
    assert WRONG[text] in str(error.value)


def rubber(shear_modulus):
    """Flags of a command for a finger of three links of a linear rubber."""
    values = ["hand.material.law=linear", f"hand.material.shear_modulus={shear_modulus}"]
    return ["--set", *values, "discretization.links=3"]


UNFIT = {
    "angle_deg\n20,0\n40,0": "every measured angle is 0: there is nothing to fit",
    "blocked_force_N\n20,0\n40,": "every measured blocked force is 0",
    "angle_deg\n0,1\n0,2": "every pressure is 0",
    "angle_deg\n20,-18.9\n40,-37.2": "angle of the other sign than the model's",
    "angle_deg,tip_force_N\n20,19,-0.5\n40,37,-1": "tip force of the other sign than the model's",
    "angle_deg\n10,400": "fitted: G = 821.3 is outside [1000, 1e+07] Pa",
    "angle_deg\n40,1e-3": "is outside [1000, 1e+07] Pa",
    "angle_deg,tip_force_N\n20,19,\n20,19,": "does not give 2 numbers",
}
"""Measurements without `pressure_kPa,` before them that no material explains."""


@pytest.mark.parametrize("text", UNFIT)
def test_what_no_material_explains_is_refused(text, tmp_path, capsys):
    path = tmp_path / "finger.csv"
    path.write_text(f"pressure_kPa,{text}\n")
    assert cli.main(["finger", str(path), "--fit", *rubber(40e3)]) == 2
    said = capsys.readouterr()
    assert UNFIT[text] in said.err and "--set" not in said.out


FITTED = {
    "angle_deg\n40,37.2": None,
    "angle_deg\n40,37.2\n40,37.2": None,
    "angle_deg,tip_force_N\n40,37.2,0.6": None,
    "angle_deg\n40,37.2\n40,38": (0.4, 2.0),
    "angle_rad\n20,0.33\n40,0.65\n60,0.99": (0.2, 2.0),
    "load_N,deflection_mm\n0,0.1,2\n0,0.2,4.1": (0.2, 4.0),
}
"""Likewise, with the range of the standard error [%] or None for none."""


@pytest.mark.parametrize("text", FITTED)
def test_a_standard_error_needs_more_values_than_numbers(text, tmp_path, capsys):
    """And what the command proposes is a value that a scene takes."""
    path = tmp_path / "finger.csv"
    path.write_text(f"pressure_kPa,{text}\n")
    assert cli.main(["finger", str(path), "--fit", *rubber(40e3)]) == 0
    said = capsys.readouterr().out
    errors = [float(e) for e in re.findall(r"standard error ([0-9.e+-]+) %", said)]
    if FITTED[text] is None:
        assert not errors and "no standard error (as many numbers as values)" in said
    else:
        low, high = FITTED[text]
        assert all(low < error < high for error in errors) and errors
    [proposed] = re.findall(r"--set (.*)", said)
    material = scene.load("paper", overrides=keypaths.parse(proposed.split())).hand.material
    assert material.law == "linear"
    assert f"shear_modulus={material.shear_modulus:.4g}" in proposed


def test_rows_that_have_a_rest_are_printed_and_the_others_named(tmp_path, capsys):
    """Also with measurements, whose signs are compared with the model's without a fit."""
    soft = rubber(8.9e3)
    assert cli.main(["finger", *soft]) == 0
    said = capsys.readouterr().out
    rows = [line.split() for line in said.splitlines() if re.match(r" +\d", line)]
    assert len(rows) == 11 and len(rows[3]) == 4 and len(rows[-1]) == 3
    assert re.search(r"warning: model: no rest found for the tip force at [\d, ]*120 kPa", said)
    path = tmp_path / "finger.csv"
    path.write_text("pressure_kPa,angle_deg,tip_force_N\n30,-20,\n120,,3\n")
    assert cli.main(["finger", str(path), *soft]) == 0
    said = capsys.readouterr().out
    assert "no rest found for the tip force at 120 kPa" in said
    assert "warning: measured and predicted angle differ in sign" in said


def test_the_command_compares_and_fits(tmp_path, capsys):
    path = tmp_path / "finger.csv"
    out = tmp_path / "out.csv"
    truth = made().of_material(50e3)
    angles = np.rad2deg([finger.Rest.of(truth, p).angles.sum() for p in (20e3, 40e3)])
    path.write_text(f"pressure_kPa,angle_deg\n20,{angles[0]}\n40,{angles[1]}\n")
    line = ["finger", str(path), "--fit", "--design", "length=110", "--out", str(out)]
    line += ["--set", *(f"{k}={v}" for k, v in material().items())]
    assert cli.main(line) == 0
    said = capsys.readouterr().out
    assert (
        "--set hand.material.law=linear hand.material.shear_modulus=5e+04" in said
        and "110 mm long" in said
    )
    assert "model: angle errs by" in said and "(25 %)" in said  # 50 / 40 - 1
    head, *rows = out.read_text().splitlines()
    assert head == "pressure_kPa,angle_deg,model_angle_deg,fitted_angle_deg" and len(rows) == 2
    # A finger of 0.8 times the model's moment bends as the model does if its pressure is divided
    # by that, and the model as the finger if the simulated one is multiplied.
    weaker = truth.of_material(50e3, 0.8)
    rows = [
        f"20,{np.rad2deg(finger.Rest.of(weaker, 20e3).angles.sum())},{16e3 * g / made().length}"
        for g in made().gain[:1]
    ]
    path.write_text("pressure_kPa,angle_deg,blocked_force_N\n" + "\n".join(rows))
    assert cli.main(line[:-2]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "moment 0.8 of the model's" in said
    assert "on the real hand divide a simulated design's pressures by 0.8 " in said
    assert "multiply the simulated pressures by 0.8 instead" in said
    bends = [
        finger.Rest.of(who, pressure).angles.sum()
        for who, pressure in (
            (truth, 20e3),
            (weaker, 20e3 / 0.8),
            (truth, 0.8 * 20e3),
            (weaker, 20e3),
        )
    ]
    np.testing.assert_allclose(bends[0::2], bends[1::2], rtol=1e-9)  # the solver's tolerance
    for wrong in (["--fit"], ["--finger", "4"], ["--out", "table.txt"], ["no.csv"]):
        assert cli.main(["finger", *wrong]) == 2
    said = capsys.readouterr().err
    assert "--fit needs measurements" in said and "--finger = 4 is outside [0, 3]" in said
    assert "must end in .csv" in said and "no.csv: No such file" in said
