"""Hard cases 6, 7, 16, 17 and 23: whole grasps of spheres, step by step against MuJoCo C."""

import functools

import mujoco
import numpy as np

from codesign_jax import model
from scripts.shared.work import NUDGE
from tests.helpers import oracles
from tests.stability.bench import bench
from tests.stability.grasp import design, good, paper, stiffest, whole_inputs
from tests.stability.oracle import Reader
from tests.stability.table import BOTH, Found, case

TIGHT = {"float32": 1e-10, "float64": 1e-24}
"""Newton decrement at which only a precision's rounding is left of a step's forces."""

ROUNDING = {"float32": 1e-4, "float64": 1e-8}
"""Relative error of accelerations.  Float64: a difference of velocities over a step loses two of 16
digits, and MuJoCo's own Newton stops at rounding of its cost.  Float32: places 0.1 m from the palm
are rounded to 1e-8 m, which a contact of 2 to 4 kN/m turns into 4e-5 N, and links weigh 5 g.  Light
links, and small steps, whose implicit springs add less inertia, are moved further by that: there
the bound is `roundings`."""

ROUNDED = 2.0**-26
"""Largest error of a float32 between 0.25 and 0.5 m [m], as places in the world are."""

STARTS = 39
"""Starts of MuJoCo C, a micrometre apart: of 40 like peaks, one is the largest in 1 of 40."""

STATES = 250
"""States of a world's path that are compared with MuJoCo C, spread evenly over it."""


def roundings(scene, fields, ctrl, path, stride) -> float:
    """How far MuJoCo C's accelerations move if gaps are rounded to float32, in 19 of 20 states.

    Each sphere's radius is rounded once; the place of a tip is a sum over the links of its finger,
    so that as many roundings come together, as the root of their number.
    """
    random = np.random.default_rng(0)
    moved = []
    for *_, compiled, data in oracles.at_states(scene, fields, ctrl, path, stride):
        exactly = data.qacc.copy()
        sizes = compiled.geom_size.copy()
        spheres = compiled.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
        compiled.geom_size[spheres, 0] += ROUNDED * random.uniform(-1, 1, spheres.sum())
        mujoco.mj_forward(compiled, data)
        compiled.geom_size[:] = sizes
        moved.append(oracles.relative_change(data.qacc, exactly))
    return float(np.sqrt(scene.discretization.links) * np.quantile(moved, 0.95))


def accelerations(base, inputs, engine, step, precision) -> Found:
    """Largest relative error of accelerations along a path, in float32 that of 19 of 20 states.

    The last one of 20 is left to pairs that touch by rounding alone: the damping of a contact acts
    at once.
    """
    b = bench(base(), engine, step, precision, TIGHT[precision])
    fields, ctrl = inputs(b)
    path = b.path(fields, ctrl)
    stride = max(1, ctrl.shape[1] // STATES)
    errors, _, touching = oracles.against_mujoco(b.scene, fields, ctrl, path, stride)
    assert touching.max() >= 1, "nothing touches: the case would be vacuous"
    compared = int(errors.count())
    assert compared, "no state is compared: the case would be vacuous"
    wide = precision == "float64"
    error = errors.max() if wide else np.quantile(errors.compressed(), 0.95)
    note = f"{compared} states, up to {touching.max()} contacts"
    bound = ROUNDING[precision]
    if not wide:
        bound = max(bound, roundings(b.scene, fields, ctrl, path, stride))
    return Found(error if np.isfinite(path.qpos).all() else np.inf, bound, note)


def kinetic(the_bench, inputs, displaced=0.0) -> tuple[float, float]:
    """Largest kinetic energy of the hand in all worlds [J], and its largest speed [rad/s].

    Args:
      the_bench: The bench that steps the worlds.
      inputs: Function of it that returns fields and controls.
      displaced: Distance of the objects from their places at the start [m].
    """
    fields, ctrl = inputs(the_bench)
    start = np.array(fields.start)
    start[:, -7] += displaced
    history = the_bench.run(fields, ctrl, start)
    if not (np.isfinite(history.qpos).all() and np.isfinite(history.qvel).all()):
        return np.inf, np.inf
    moving = slice(0, int(model.layout(the_bench.scene).dofs.max()) + 1)
    every = max(1, ctrl.shape[1] // 900)
    largest = 0.0
    for world in range(len(ctrl)):
        reader = Reader(the_bench.scene, fields, world)
        states = zip(history.qpos[world, ::every], history.qvel[world, ::every], strict=True)
        largest = max(largest, *(reader.kinetic(q, v, moving) for q, v in states))
    return float(largest), float(history.speed.max())


@functools.cache
def fine_kinetic(base, inputs):
    """The same in MuJoCo C at an eighth of the paper's step: the largest of three starts.

    Where fingers start in one place (spread 0) the peak at a coarse step is a matter of chance: at
    10 ms a micrometre's move of the object changes it from 9 to 21 mJ.
    """
    fine = bench(base(), "mujoco", 1 / 8, "float64")
    return max(kinetic(fine, inputs, x)[0] for x in (-NUDGE, 0.0, NUDGE))


def coarse_kinetic(base, inputs, step):
    """The largest of MuJoCo C at the same step, from starts a micrometre apart."""
    same = bench(base(), "mujoco", step, "float64")
    places = NUDGE * (np.arange(STARTS) - STARTS // 2)
    return max(kinetic(same, inputs, x)[0] for x in places)


def energies(base, inputs, engine, step, precision) -> Found:
    """A step damps and must not excite; contacts make a path, and its peak, uncertain.

    Beyond a factor of two the bound is what the same step does to MuJoCo C.
    """
    energy, speed = kinetic(bench(base(), engine, step, precision), inputs)
    fine = fine_kinetic(base, inputs)
    bound = 2.0
    note = f"fastest {speed:.0f} rad/s"
    if engine == "structured" and energy / fine > bound:
        bound = max(bound, coarse_kinetic(base, inputs, step) / fine)
        note += f", MuJoCo C at this step from {STARTS} starts up to {bound:.2f}"
    return Found(energy / fine, bound, note)


def softest(b):
    """180 mm, h 15, d 2 at the pressure limit of 80 kPa, on the object and the table."""
    changes = {"length": 180, "height": 15, "wall": 2, "arm_z": 60, "pressure": 79.99}
    return whole_inputs(b, [design(b.scene, **changes)])


def pressing(b):
    """All fingers on the object and on the table."""
    return whole_inputs(b, [design(b.scene, arm_z=20)], (0, 1, 2))


def edge_designs(b):
    """Spread 0 and 110 degrees, and no pressure."""
    designs = [design(b.scene, spread=x) for x in (0, 110)]
    return whole_inputs(b, [*designs, design(b.scene, pressure=0)])


@functools.cache
def shaken():
    """Twice the paper's frequency, the largest angle."""
    return paper(arm__shake_amplitude=90.0, arm__shake_frequency=3.0)


def register(number, title, base, inputs, *, energy=True):
    """The accelerations of a grasp, and its energy.

    Args:
      number: Number of the case.
      title: Its title.
      base: Function that returns the scene.
      inputs: Function of a bench that returns fields and controls.
      energy: Whether the energy is measured as well.
    """
    name = f"{base.__name__}_{inputs.__name__}"
    against = "accelerations along the path against MuJoCo C, relative"
    measure = functools.partial(accelerations, base, inputs)
    case(number, title, against, name=f"{name}_accelerations", steps=(1.0, 0.5))(measure)
    if energy:
        peak = "largest kinetic energy over MuJoCo C's at h/8"
        options = {"name": f"{name}_energy", "engines": BOTH, "precisions": ("float32",)}
        case(number, title, peak, **options)(functools.partial(energies, base, inputs))


register(6, "stiffest corner of Table I, 9 s", paper, stiffest, energy=False)
register(7, "softest corner of Table I, 9 s", paper, softest)
register(16, "shake of 90 degrees at 3 Hz", shaken, good)
register(17, "all fingers on the object and the table", paper, pressing, energy=False)
register(23, "edges of the parameters", paper, edge_designs)
