"""Gradients of the structured engine against central differences of the same program.

All cases are worlds of one batch in float64, so that they share one compile: the world and its
perturbed copies.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import control, model, rollout
from codesign_jax.engines.structured import StructuredEngine
from tests.helpers import grasps

# One program, but its derivative compiles in two minutes of a core's time.
pytestmark = pytest.mark.slow

STEPS, STEP = 50, 2e-6
# Factors on the design's lengths, pressures, the object's mass, size and friction, then lift of the
# arm [m], lift of the object [m] and its start velocity along x [m/s], which no derivative reaches.
NAMES = ("length", "pressure", "mass", "size", "friction", "arm", "height", "velocity")
START = {"length": 1.0, "pressure": 1.0, "mass": 1.0, "size": 1.0, "friction": 1.0}
AWAY = {"arm": 0.1}  # the hand stays high above everything

# Case: values, the parameters to check and the relative tolerance.  Central differences with a
# step e lose e^2 f'''/6f' to truncation and 1e-16 f/(e f') to rounding, each about 1e-9 here at
# e = 1e-5 to 1e-6; contact adds the solver's error of about 1e-12 / e.
CASES = {
    "bending": (AWAY, ("length", "pressure"), 1e-7),
    "falling": (AWAY | {"height": 2.0, "velocity": 0.3}, ("height",), 1e-8),
    "resting": (AWAY | {"height": 1e-3}, ("mass", "size", "height"), 1e-6),
    "sticking": (AWAY | {"velocity": 0.2}, ("mass", "size", "friction"), 1e-6),
    "sliding": (AWAY | {"velocity": 4.0}, ("mass", "size", "friction"), 1e-6),
    "grasp": ({}, ("length", "pressure", "mass", "size", "arm"), 1e-6),
}


class Thrown(StructuredEngine):
    """The engine with worlds whose object moves along x at the start."""

    def __init__(self, scene, velocity, **limits):
        super().__init__(scene, **limits)
        self.velocity = velocity

    def reset(self, fields):
        state = super().reset(fields)
        return state._replace(linear_vel=state.linear_vel.at[0, 0].set(self.velocity))


def world(scene, design, value):
    """Model fields and controls of one world from a design, its trial and the values of NAMES."""
    params, trial = design
    params = params._replace(
        length=params.length * value["length"],
        pressure=params.pressure * value["pressure"] * jnp.array([1.0, 0.9]),
        arm=params.arm + value["arm"] * jnp.eye(6)[2],
    )
    trial = trial._replace(
        mass=value["mass"],
        size=value["size"],
        friction=value["friction"],
        yaw=0.1,
        position=jnp.array([0.003, 0.002]),
    )
    trial = jax.tree.map(jnp.asarray, trial)
    fields = model.model_fields(scene, params, trial)
    start = fields.start.at[-5].add(value["height"])
    return fields._replace(start=start), control.commands(scene, params, trial)[:STEPS]


def simulate(scene, design, values):
    """A weighted sum of every world's final coordinates, and the box's position in them."""
    values = dict(zip(NAMES, values.T, strict=True))
    fields, ctrl = jax.vmap(lambda v: world(scene, design, v))(values)
    # Solved to rounding: differences divide the solver's error by 1e-6.
    limits = {"iterations": 100, "evaluations": 40, "tolerance": 1e-24}
    engine = Thrown(scene, jax.lax.stop_gradient(values["velocity"]), **limits)
    qpos = engine.rollout(fields, ctrl, trajectory=True).qpos[:, -1]
    weights = np.random.default_rng(0).normal(size=qpos.shape[1])
    return qpos @ weights, qpos[:, -7:-4]


@pytest.fixture(scope="module")
def checked():
    """By case: gradients, central differences, final position of the object."""
    scene, rows, where = grasps.short_grasp(), [], {}
    for case, (changes, names, _) in CASES.items():
        base = np.array([{**START, **changes}.get(n, 0.0) for n in NAMES])
        where[case] = len(rows)
        rows.append(base)
        for name in names:
            for step in (STEP, -STEP):
                rows.append(base + step * (np.array(NAMES) == name))
    design = grasps.hand_world(scene)
    with jax.enable_x64(True):

        def loss(values):
            value, place = simulate(scene, design, values)
            return value.sum(), (value, place)

        run = jax.jit(jax.grad(loss, has_aux=True))
        slope, (value, place) = jax.tree.map(np.asarray, run(jnp.array(rows)))
    found = {}
    for case, (_, names, _) in CASES.items():
        first = where[case]
        sides = value[first + 1 : first + 1 + 2 * len(names)].reshape(-1, 2)
        differences = (sides[:, 0] - sides[:, 1]) / (2 * STEP)
        columns = [NAMES.index(n) for n in names]
        found[case] = slope[first, columns], differences, place[first]
    return found


@pytest.mark.parametrize("case", CASES)
def test_gradient_equals_central_differences(checked, case):
    slope, differences, _ = checked[case]
    error = np.abs(slope - differences).max() / np.abs(slope).max()
    print(case, error)
    assert error < CASES[case][2], (slope, differences)


def test_the_cases_are_what_they_say(checked):
    """The box falls freely, rests, slides to a stop, slides to the end, is held."""
    place = {case: v[2] for case, v in checked.items()}
    fallen = 9.81 * 0.01**2 * (STEPS - 1) * STEPS / 2
    assert place["falling"][2] == pytest.approx(2.03 - fallen, abs=1e-9)
    assert abs(place["resting"][2] - 0.03) < 1e-3
    # Friction stops 0.2 m/s in 4 mm and 0.04 s, 4 m/s not in the half second.
    assert 1e-3 < place["sticking"][0] - 0.003 < 8e-3
    assert place["sliding"][0] - 0.003 > 1.0


# --- by every physical number of a scene ----------------------------------------------------------


CHANGE = 1e-6
# Times of the key frames: a command has a kink where a step falls on one, as all of them here do.
KINKS = ("phases",)
# What a grasp of given trials does not depend on: verdicts, noise, and effects that are off.
WITHOUT = ("cost", "limits", "pneumatics", "objects.noise", "arm.shake", "hand.palm.contact_radius")
MOVING = {
    "gravity",
    "contact.normal_stiffness",
    "contact.dissipation_time",
    "contact.friction_ratio",
    "hand.material.shear_modulus",
    "hand.material.damping_time",
    "hand.material.density",
    "hand.palm.mass",
    "hand.section.width",
    "hand.wrist.linear_stiffness",
    "hand.finger[0].tilt",
    "objects.object[0].friction",
    "objects.object[0].mass",
    "objects.object[0].size[0]",
    "objects.table.friction",
}
"""Some of the numbers whose derivative must not be zero, so that zeros prove nothing."""


def grasp(dtype, **settings):
    """The scene's numbers, and the function from numbers of worlds, (world,), to their losses."""
    scene = grasps.short_grasp()
    engine = StructuredEngine(scene, **settings)
    hand, trial = jax.tree.map(
        lambda v: jnp.asarray(v, dtype if v.dtype.kind == "f" else None), grasps.hand_world(scene)
    )
    trial = trial._replace(yaw=trial.yaw + 0.1, position=trial.position + 0.003)

    def losses(constants):
        count = jax.tree.leaves(constants)[0].shape[0]
        worlds = jax.tree.map(lambda v: jnp.broadcast_to(v, (count, *v.shape)), (hand, trial))
        # `evaluate` would do: what is differentiated are the coordinates at the end.
        _, trace = rollout.simulate(scene, engine, *worlds, record_qpos=True, constants=constants)
        end = jnp.concatenate(model.split(scene, trace.last)[:2], 1)
        size = end.shape[1]
        weights = np.random.default_rng(0).normal(size=size) / np.sqrt(size)
        return end @ jnp.asarray(weights, dtype)

    return jax.tree.map(lambda v: jnp.asarray([v], dtype), scene.constants()), losses


def slopes(start, losses):
    """Derivatives along every number, each relative to a change of the number by its own size."""
    found = jax.jit(jax.grad(lambda c: losses(c).sum()))(start)
    return np.array(
        [
            float(g[0] * size_of(v))
            for g, v in zip(*map(jax.tree.leaves, (found, start)), strict=True)
        ]
    )


def size_of(value):
    return np.where(np.asarray(value) != 0, np.abs(value), 1.0)[0]


def names_of(tree):
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [jax.tree_util.keystr(path).lstrip(".") for path, _ in pairs]


@pytest.fixture(scope="module")
def by_constants():
    """Names, derivatives in float64 with the solver converged, differences; default derivatives."""
    start, losses = grasp(np.float32)
    default = slopes(start, losses)
    with jax.enable_x64(True):
        start, losses = grasp(np.float64, iterations=60, evaluations=30, tolerance=1e-24)
        names, leaves = names_of(start), jax.tree.leaves(start)
        sides = []
        for sign in (1, -1):
            # World i has number i moved, the others as they are.
            moved = [
                jnp.full(len(leaves), v[0]).at[i].add(sign * CHANGE * size_of(v))
                for i, v in enumerate(leaves)
            ]
            sides.append(jax.tree.unflatten(jax.tree.structure(start), moved))
        run = jax.jit(losses)
        high, low = (np.asarray(run(side)) for side in sides)
        return names, slopes(start, losses), (high - low) / (2 * CHANGE), default


def test_gradient_by_every_constant_equals_central_differences(by_constants):
    names, slope, difference, _ = by_constants
    largest = np.abs(slope).max()
    error = np.abs(slope - difference) / largest
    for name, *row in zip(names, slope, difference, error, strict=True):
        print(name, *(f"{v:.3e}" for v in row))
    assert MOVING <= {n for n, s in zip(names, slope, strict=True) if abs(s) > 1e-6 * largest}
    for name, s, e in zip(names, slope, error, strict=True):
        if name.startswith(WITHOUT):
            assert s == 0, name
        if not name.startswith(KINKS):
            # The solver's rounding of 1e-15 over the step: 5e-10 were seen.
            assert e < 1e-8, name


def test_the_default_gradient_in_float32(by_constants):
    """Its error is that of float32 steps and of the default solver's tolerance."""
    names, slope, _, found = by_constants
    smooth = np.array([not n.startswith(KINKS) for n in names])
    error = np.linalg.norm((found - slope)[smooth]) / np.linalg.norm(slope[smooth])
    print("float32", error)
    for name, *row in zip(names, slope, found, strict=True):
        print(name, *(f"{v:.3e}" for v in row))
    assert error < 5e-3  # 6e-4 were seen
