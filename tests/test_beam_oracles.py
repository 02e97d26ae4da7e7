"""One finger, built as every hand is, against closed forms of beams, rods and pendulums.

The finger leaves a palm on a stiff wrist horizontally.  Statics come from stepping until nothing
moves: the implicit springs damp, and the fixed point of a step is the static solution.  Loads and
positions are taken in the palm's frame, so that the wrist's remaining compliance does not matter.
"""

import mujoco
import numpy as np
import pytest
from scipy import linalg

from tests.helpers import beams
from tests.helpers.beams import Finger

# --- statics -------------------------------------------------------------------------------------


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
    np.testing.assert_allclose(beams.elastica(alpha), continuum, atol=5e-9)
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


# --- dynamics ------------------------------------------------------------------------------------


def eigenfrequencies(finger):
    """Angular frequencies of the finger on a fixed palm, from MuJoCo's mass matrix, ascending."""
    m, dofs = finger.model, finger.layout.dofs.ravel()
    finger.data.qpos[6 + np.arange(dofs.size)] = 0.0
    mujoco.mj_forward(m, finger.data)
    mass = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, finger.data, mass)
    mass -= np.diag(m.dof_armature)
    stiffness = np.diag(m.jnt_stiffness[dofs])
    values, vectors = linalg.eigh(stiffness, mass[np.ix_(dofs, dofs)])
    return np.sqrt(values), vectors


@pytest.mark.parametrize(
    "damping, beta, acts",
    [
        ("added", 6e-3, 7e-3),
        ("least", 6e-3, 6e-3),
        ("least", 5e-4, 1e-3),
    ],
)
def test_ring_down(damping, beta, acts):
    """Log decrement 2 pi zeta / sqrt(1 - zeta^2) with zeta = omega / 2 times a Kelvin-Voigt time.

    That time is beta + h or max(beta, h) by `spring_damping`, to first order in h omega,
    which is 7e-3 here.
    """
    finger = Finger(5, timestep=1e-3, length=0.3, damping=damping, beta=beta)
    omega, shape = eigenfrequencies(finger)
    m, d = finger.model, finger.data
    d.qpos[6:11] = 1e-3 * shape[:, 0] / np.abs(shape[:, 0]).max()
    d.qvel[:] = 0.0
    d.ctrl[2] = d.qpos[2]
    angle = []
    for _ in range(4000):
        angle.append(d.qpos[6])
        mujoco.mj_step(m, d)
    angle = np.array(angle)
    peaks = np.flatnonzero((angle[1:-1] > angle[:-2]) & (angle[1:-1] >= angle[2:])) + 1
    h, zeta = 1e-3, acts * omega[0] / 2
    period = 2 * np.pi / (omega[0] * np.sqrt(1 - zeta**2))
    assert len(peaks) >= 4
    # Four periods of 0.85 s, peaks at whole steps.
    assert (peaks[3] - peaks[0]) / 3 * h == pytest.approx(period, rel=1e-3)
    decrement = np.log(angle[peaks[0]] / angle[peaks[3]]) / 3
    # Of a weak damping the first-order term is a larger share: of 1 ms half a per cent.
    assert decrement == pytest.approx(2 * np.pi * zeta / np.sqrt(1 - zeta**2), rel=6e-3)


def test_free_fall():
    """Semi-implicit Euler falls g h^2 n (n + 1) / 2 in n steps, exactly."""
    finger = Finger(1, gravity=9.81)
    m, d = finger.model, finger.data
    d.qpos[-5] = 2.0
    for _ in range(50):
        mujoco.mj_step(m, d)
    assert 2.0 - d.qpos[-5] == pytest.approx(9.81 * 0.01**2 * 50 * 51 / 2, rel=1e-12)
    assert 2.0 - d.qpos[-5] == pytest.approx(9.81 * 0.5**2 / 2, rel=0.02 + 1e-9)  # h / t
