"""One finger: its beam theory, its chain in MuJoCo C and its swing, against closed forms.

The finger leaves a palm on a stiff wrist horizontally.  Statics come from stepping until nothing
moves: the implicit springs damp, and the fixed point of a step is the static solution.  Loads and
positions are taken in the palm's frame, so that the wrist's remaining compliance does not matter.
"""

import dataclasses
import functools

import mujoco
import numpy as np
import pytest
from scipy import integrate, linalg, optimize, special

from codesign_jax import finger as bench
from codesign_jax import model, scene
from codesign_jax.finger import rest, swing
from codesign_jax.model import morphology
from codesign_jax.scene import hand
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
    finger_hand = dataclasses.replace(
        the_scene.hand,
        finger=(hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=0.0),),
        wrist=hand.Wrist(1e5, 1e4, 1e3, 1e2),
        material=dataclasses.replace(
            the_scene.hand.material, shear_modulus=shear_modulus, damping_time=beta
        ),
    )
    return dataclasses.replace(the_scene, hand=finger_hand, gravity=gravity)


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
        ones = np.ones(1)
        zero = np.zeros(())
        params = Params(length * ones, height * ones, wall * ones, zero, np.zeros(6), 0 * ones)
        trial = Trial(np.int32(0), np.zeros(2), zero, np.zeros(2), np.ones(()), np.ones(()))
        self.model = model.compile_model(scene, params, trial)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2] = self.data.ctrl[2] = 0.3
        width = scene.hand.section.width
        material = scene.hand.material
        constants = {"shear_modulus": material.shear_modulus, "density": material.density}
        self.beam = morphology.beam(height, wall, width=width, **constants)

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
        displacement = balanced(finger, princeton_rigidity(), force) - [finger.length, 0.0, 0.0]
        np.testing.assert_allclose(displacement, expected, atol=far * finger.length)
        assert displacement[1] == pytest.approx(expected[1], rel=aside, abs=1e-9)


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
    segments = morphology.segments(hand, params, links)
    length = params.length
    height = params.height
    mass = beams.line_density[:, 0] * params.length
    joint = np.cumsum(segments.offset, 1)
    # A joint stands in the middle of each segment.
    np.testing.assert_allclose(joint, np.outer(length, (np.arange(links) + 0.5) / links))
    start = np.concatenate([0 * joint[:, :1], joint], 1)
    np.testing.assert_allclose(start[:, 1:], (start + segments.extent)[:, :-1], rtol=1e-12)
    centre = start + segments.extent / 2
    np.testing.assert_allclose(segments.mass.sum(1), mass)
    np.testing.assert_allclose((segments.mass * centre).sum(1), mass * length / 2)
    about = (segments.inertia[..., 1] + segments.mass * centre**2).sum(1)
    np.testing.assert_allclose(about, mass * (length**2 / 3 + height**2 / 12))
    for name, rigidity in (("bend", "bending"), ("lateral", "lateral"), ("twist", "torsion")):
        stiffness, damping = morphology.joint_springs(hand, params, beams, links, (name,))
        whole = length / getattr(beams, rigidity)[:, 0]
        np.testing.assert_allclose(links / stiffness[:, 0, 0], whole)
        np.testing.assert_allclose(damping, hand.material.damping_time * stiffness)
    spheres = morphology.sphere_places(segments.extent, 3)
    assert spheres.shape == (2, links, 3)
    np.testing.assert_allclose(spheres.mean(2), segments.extent[:, 1:] / 2)
    np.testing.assert_allclose(np.diff(spheres, axis=2).max(2), segments.extent[:, 1:] / 3)


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
            segments = morphology.segments(hand, params, links)
            start = np.concatenate([[0], np.cumsum(segments.offset[f])])
            assert segments.mass[f].sum() == pytest.approx(mass, rel=1e-12)
            centre = start + segments.along[f]
            assert (centre * segments.mass[f]).sum() / mass == pytest.approx(along, rel=1e-12)
            assert (segments.up[f] * segments.mass[f]).sum() / mass == pytest.approx(up, rel=1e-12)
            # Midpoints: the error of a joint's angle goes with the square of its segment.
            beams = morphology.finger_beams(hand, params, links)
            springs, _ = morphology.joint_springs(hand, params, beams, links, ("bend",))
            chain = (beams.moment_per_pressure[f] / springs[f, :, 0]).sum()
            assert chain == pytest.approx(bend, rel=0.12 / links**2)
        free = morphology.free_bends(
            hand, params._replace(pressure=np.full(2, 1e5)), neo_hookean=False
        )
        assert free[f] == pytest.approx(1e5 * bend, rel=1e-4)


# --- one finger on the bench, against MuJoCo's chain ----------------------------------------------


def on_the_bench(chain):
    """The finger of the bench that is the one of MuJoCo's chain."""
    zero = np.zeros(())
    ones = np.ones(1)
    params = Params(chain.length * ones, 0.02 * ones, 0.005 * ones, zero, np.zeros(6), 0 * ones)
    return bench.of_design(chain.scene, params, 0)


@pytest.mark.parametrize("alpha", [1, 2])
def test_a_large_load_on_the_bench_gives_the_elastica(alpha):
    """Bisshopp and Drucker's tip; at 40 links the chain errs by 3e-4 at most."""
    mine = on_the_bench(Finger(40))
    load = alpha * mine.stiffness[0] * mine.segment / mine.length**2
    at_rest = rest.Rest.of(mine, 0.0, load)
    assert -at_rest.height / mine.length == pytest.approx(elastica(alpha)[0], rel=3e-4)


@pytest.mark.parametrize("bend", [0, 60, 120])
def test_a_small_load_moves_a_bent_tip_sideways_as_the_chain_s(bend):
    """As its forty links, which ten of them lack 1.2 % of: axes in the middle of a joint's bend."""
    rigidity = np.array([6.8e-3, 5.1e-3, 1.75e-3])
    chain = Finger(10, bending_only=False)
    displacement = balanced(chain, rigidity, np.array([0.0, 1e-3, 0.0]), np.deg2rad(bend))[1]
    spring = rigidity * chain.links / chain.length
    bench_finger = on_the_bench(chain)._replace(lateral=spring[1:2], twist=spring[2:])
    bent = rest.Rest(np.full(10, np.deg2rad(bend) / 10), 0.0, 0.0)
    assert rest.sideways(bench_finger, bent, 0.0, 1e-3) == pytest.approx(displacement, rel=0.02)


def test_a_released_finger_swings_as_the_chain_s():
    """By its own weight, under its wall's damping: MuJoCo's tip over the first three swings.

    Newmark at 1 ms errs by a thousandth of the period of 0.1 s; the palm's springs yield as much.
    """
    chain = Finger(5, timestep=1e-3, gravity=swing.GRAVITY, integrator="newmark", length=0.15)
    chain.data.ctrl[2] = chain.data.qpos[2]
    tips = []
    for _ in range(300):
        mujoco.mj_step(chain.model, chain.data)
        mujoco.mj_kinematics(chain.model, chain.data)
        tips.append(-chain.tip()[0][2])
    bench_finger = on_the_bench(chain)
    step = swing.first_period(bench_finger, 0.0) / swing.STEPS
    time, drop = swing.released(bench_finger, 0.0, 0.0, 0.3, step)
    expected = np.interp(1e-3 * (np.arange(300) + 1), time, drop)
    np.testing.assert_allclose(tips, expected, atol=0.02 * expected.max())
