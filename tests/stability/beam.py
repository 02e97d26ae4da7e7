"""Hard cases 2 and 3: one finger against closed forms of beams."""

import functools

import mujoco
import numpy as np
from scipy import integrate, linalg

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.model import morphology
from codesign_jax.types import Params
from tests.helpers import grasps
from tests.helpers.beams import Finger, finger_scene
from tests.stability.bench import bench
from tests.stability.table import BOTH, Found, case

HEIGHT, WALL = 0.020, 0.005


class Rod:
    """The one-finger scene on a bench, with its beam properties and MuJoCo C to read states."""

    def __init__(
        self,
        engine,
        step,
        precision,
        *,
        links=10,
        length=0.1,
        height=HEIGHT,
        wall=WALL,
        damped=True,
    ):
        base = finger_scene(links)
        if not damped:
            base = undamped(links)
        self.bench = bench(base, engine, step, precision)
        self.links, self.length, self.h = links, length, self.bench.h
        one = np.ones(1)
        params = Params(length * one, height * one, wall * one, np.zeros(()), np.zeros(6), 0 * one)
        self.fields = self.bench.fields([params], [grasps.still()])
        self.model = world_model(self.bench.scene, grasps.nth(self.fields, 0))
        self.data, self.lay = mujoco.MjData(self.model), model.layout(self.bench.scene)
        material = self.bench.scene.hand.material
        self.beam = morphology.beam(
            height,
            wall,
            width=self.bench.scene.hand.section.width,
            shear_modulus=material.shear_modulus,
            density=material.density,
        )
        self.joints = 6 + np.arange(links)

    def run(self, pressure, start=None):
        """History under pressures (time,) from finger angles (links,) at rest."""
        qpos = self.fields.start.copy()
        if start is not None:
            qpos[0, self.joints] = start
        ctrl = np.zeros((1, len(pressure), self.model.nu))
        ctrl[0, :, :6], ctrl[0, :, 6] = qpos[0, :6], pressure
        return self.bench.run(self.fields, ctrl, qpos)

    def tip(self, qpos):
        """Tip of the bottom layer in the frame of the finger's root."""
        m, d, last = self.model, self.data, self.lay.bodies[0, -1]
        d.qpos[:] = qpos
        mujoco.mj_kinematics(m, d)
        end = d.xpos[last] + d.xmat[last].reshape(3, 3) @ [self.length / self.links / 2, 0, 0]
        return d.xmat[1].reshape(3, 3).T @ (end - d.xpos[1])

    def mass(self, qpos):
        """Mass matrix of the finger's joints without what the implicit springs add."""
        m, d = self.model, self.data
        d.qpos[:] = qpos
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_crb(m, d)
        full = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, full)
        return (full - np.diag(m.dof_armature))[np.ix_(self.joints, self.joints)]

    def mode(self):
        """First angular frequency and mode shape, largest angle 1."""
        stiffness = np.diag(self.model.jnt_stiffness[self.joints])
        values, vectors = linalg.eigh(stiffness, self.mass(self.fields.start[0]))
        shape = vectors[:, 0]
        return np.sqrt(values[0]), shape / shape[np.abs(shape).argmax()]

    def energy(self, history):
        """Kinetic and spring energy after every step [J]."""
        k, out = self.model.jnt_stiffness[self.joints], []
        for qpos, qvel in zip(history.qpos[0], history.qvel[0], strict=True):
            q, v = qpos[self.joints].astype(float), qvel[self.joints].astype(float)
            out.append(0.5 * v @ self.mass(qpos) @ v + 0.5 * (k * q) @ q)
        return np.array(out)


@functools.cache
def undamped(links):
    """The one-finger scene without the material's damping; the scheme's own remains."""
    import dataclasses

    base = finger_scene(links)
    material = dataclasses.replace(base.hand.material, damping_time=0.0)
    return dataclasses.replace(base, hand=dataclasses.replace(base.hand, material=material))


def by_quadrature(rod):
    """Bending stiffness E I [N m^2] and moment per pressure [m^3] of the section, by quadrature."""
    width = rod.bench.scene.hand.section.width

    def solid(y):
        return width if y < WALL or y > HEIGHT - WALL else 2 * WALL

    edges = [0, WALL, HEIGHT - WALL, HEIGHT]
    pairs = list(zip(edges, edges[1:], strict=False))
    second = sum(integrate.quad(lambda y: y * y * solid(y), *p)[0] for p in pairs)
    first = integrate.quad(lambda y: y * (width - 2 * WALL), *pairs[1])[0]
    return 4 * rod.bench.scene.hand.material.shear_modulus * second, first


@case(2, "roll-up to a full circle", "tip to root over length", engines=BOTH)
def roll_up(engine, step, precision):
    """M = 2 pi E I / L closes the midpoint chain exactly; pressure grows for 2 s, rests for 3.

    E I and M come from integrals over the section and not from the package's beam theory.
    """
    rod = Rod(engine, step, precision)
    bending, moment = by_quadrature(rod)
    full = 2 * np.pi * bending / rod.length / moment
    time = np.arange(round(5 / rod.h)) * rod.h
    history = rod.run(full * np.clip(time / 2, 0, 1))
    gap = np.linalg.norm(rod.tip(history.qpos[0, -1])) / rod.length
    # Ten angles of 0.6 rad; float32 has 6e-8 of each, and of the torques that make them.
    return Found(gap, {"float64": 1e-7, "float32": 1e-5}[precision])


@case(
    3,
    "45 degree bend, P = 300 and 600",
    "largest error of a tip component, relative",
    engines=("mujoco",),
    steps=(0.2, 0.1, 0.05),
)
def bend_45(engine, step, precision):
    """Bathe and Bolourchi (1979), tips of Simo and Vu-Quoc (1986): R = 100, E I = G J = 8.333e5.

    In our units the radius is 1 m and the load P R^2 / E I; a curved chain is a straight one whose
    lateral springs rest at pi / 4 N.
    """
    worst = 0.0
    for load, expected in ((300, (58.84, 22.33, 40.08)), (600, (47.23, 15.79, 53.37))):
        finger = Finger(60, length=np.pi / 4, bending_only=False, timestep=0.01 * step)
        m, dofs = finger.model, finger.layout.dofs[0]
        bending = finger.beam.bending
        spacing, h = finger.length / finger.links, m.opt.timestep
        k = bending / spacing
        m.jnt_stiffness[dofs] = k
        beta = 1.0  # near critical for the first mode of 0.2 Hz, to be at rest soon
        m.dof_damping[dofs] = beta * k + h * k
        m.dof_armature[dofs] = h * (beta * k + h * k)
        m.qpos_spring[dofs[:, 1]] = np.pi / 4 / finger.links
        finger.data.qpos[dofs[:, 1]] = np.pi / 4 / finger.links
        force = load * 100.0**2 / 8.333e5 * bending
        position, _ = finger.settle(force=(0, 0, force), steps=60000)
        # Theirs: the root's tangent is their y, the centre of curvature on their x, load along z.
        worst = max(worst, np.abs(100 * position / np.array(expected) - 1).max())
    return Found(worst, 0.015, "60 links, base step 2 ms")
