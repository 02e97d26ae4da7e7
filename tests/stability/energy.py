"""Hard cases 4, 5 and 8: vibration, damping and a jump of the pressure of one finger."""

import functools

import numpy as np

from tests.stability.beam import Rod
from tests.stability.bench import History
from tests.stability.table import BOTH, Found, case

LONG = {"links": 5, "length": 0.18, "height": 0.015, "wall": 0.002}
"""The slowest finger of Table I."""


FINE = {"steps": (0.1, 0.05, 0.025), "engines": BOTH}


@case(
    4,
    "free vibration, up to 100 periods",
    "loss of energy against the scheme's, relative",
    **FINE,
)
def free_vibration(engine, step, precision):
    """The energy of the first mode falls as implicit Euler's: (1 + h^2 omega^2)^-1 a step.

    Without material damping, for 100 periods or until a thousandth of it is left.  More is energy
    from nowhere, less is damping that nobody asked for.
    """
    rod = Rod(engine, step, precision, damped=False, **LONG)
    # The stiff wrist moves by 3e-7 m.  At a height of 0.3 m, where floats are 3e-8 apart, what it
    # moves in a step would be lost, and a spring that never stretches leaves a damper alone.
    rod.fields.start[0, 2] = 0.0
    omega, shape = rod.mode()
    rate = np.log1p((rod.h * omega) ** 2)
    steps = int(min(100 * 2 * np.pi / omega / rod.h, np.log(1e3) / rate))
    history = rod.run(np.zeros(steps), 0.02 * shape)
    energy = rod.energy(History(history.qpos[:, -1:], history.qvel[:, -1:]))
    k = rod.model.jnt_stiffness[rod.joints]
    lost = -np.log(energy[-1] / (0.5 * (k * (0.02 * shape) ** 2).sum()))
    periods = steps * rod.h * omega / 2 / np.pi
    # The amplitude's square, 4e-4, and the wrist's compliance.
    return Found(abs(lost / (rate * steps) - 1), 0.01, f"{periods:.0f} periods")


@case(
    4,
    "free vibration",
    "first frequency against that of implicit Euler, relative",
    quick="mujoco",
    **FINE,
)
def vibration_frequency(engine, step, precision):
    """Zero crossings of the first periods against the chain's own frequency."""
    rod = Rod(engine, step, precision, damped=False, **LONG)
    omega, shape = rod.mode()
    history = rod.run(np.zeros(round(6 * 2 * np.pi / omega / rod.h)), 0.01 * shape)
    angle = history.qpos[0, :, 6].astype(float)
    turn = np.flatnonzero(np.diff(np.sign(angle)) != 0)
    # Where the straight line between two steps crosses zero.
    time = (turn + angle[turn] / (angle[turn] - angle[turn + 1])) * rod.h
    found = np.pi * (len(time) - 1) / (time[-1] - time[0])
    # Linearly implicit springs without damping are implicit Euler: atan(h omega) / h.
    scheme = np.arctan(rod.h * omega) / rod.h
    # Left are the amplitude's square and the wrist's compliance, 2e-5 at every step.
    note = f"the scheme's own shift is {1 - scheme / omega:.1e}"
    return Found(abs(found / scheme - 1), 1e-4, note)


@case(
    5,
    "damped release",
    "largest rise of energy in a step over the first",
    engines=BOTH,
    quick="mujoco",
)
def damped_release(engine, step, precision):
    """Let go from half a circle of the paper's finger, with its damping."""
    rod = Rod(engine, step, precision)
    history = rod.run(np.zeros(round(2 / rod.h)), np.full(10, np.pi / 10))
    k = rod.model.jnt_stiffness[rod.joints]
    energy = np.r_[0.5 * (k * (np.pi / 10) ** 2).sum(), rod.energy(history)]
    rise = max(np.diff(energy).max(), 0.0)
    return Found(rise / energy[0], {"float64": 1e-12, "float32": 1e-6}[precision])


@case(5, "damped release", "energy against the mode's recurrence", engines=BOTH)
def damping_law(engine, step, precision):
    """The first mode at 0.01 rad against its recurrence, for the time in which half of it is lost.

    (1 + h beta omega^2 + h^2 omega^2) v' = v - h omega^2 q and q' = q + h v', with the material's
    beta: the dampers are implicit as the springs are.
    """
    rod = Rod(engine, step, precision, **LONG)
    omega, shape = rod.mode()
    beta, q, v = rod.bench.scene.hand.material.damping_time, 0.01, 0.0
    expected = []
    while not expected or (expected[-1] > 0.5 and len(expected) < 5000):
        v = (v - rod.h * omega**2 * q) / (1 + rod.h * beta * omega**2 + (rod.h * omega) ** 2)
        q = q + rod.h * v
        expected.append((q**2 + (v / omega) ** 2) / 0.01**2)
    energy = rod.energy(rod.run(np.zeros(len(expected)), 0.01 * shape))
    first = 0.5 * (rod.model.jnt_stiffness[rod.joints] * (0.01 * shape) ** 2).sum()
    error = np.abs(energy / first - expected).max()
    # The amplitude's square, 1e-4, and the wrist's compliance.
    return Found(error, 1e-3, f"{len(expected)} steps")


JUMP = (8, "pressure step of 120 kPa in one time step")


def kinetic_peak(rod):
    """Largest kinetic energy after a step to 120 kPa [J]."""
    history = rod.run(np.full(round(0.5 / rod.h), 120e3))
    k = rod.model.jnt_stiffness[rod.joints]
    spring = 0.5 * (k * history.qpos[0][:, rod.joints].astype(float) ** 2).sum(1)
    return (rod.energy(history) - spring).max()


@functools.cache
def converged_peak():
    return kinetic_peak(Rod("mujoco", 1 / 64, "float64"))


@case(*JUMP, "largest kinetic energy over C's at h/64", engines=BOTH)
def pressure_speed(engine, step, precision):
    """Implicit springs damp what the jump excites; a step must not add to it.

    The largest kinetic energy grows with smaller steps, towards MuJoCo C's at h/64.
    """
    found = kinetic_peak(Rod(engine, step, precision)) / converged_peak()
    return Found(found, 1.02)
