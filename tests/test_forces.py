"""Recorded contact forces: momentum, MuJoCo's own, and that recording changes nothing."""

import csv
import functools
import re
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import cli, model, rollout
from codesign_jax.commands import forces as push
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine, forces
from codesign_jax.engines.structured.coordinates import reset
from codesign_jax.engines.structured.kernel.program import Program
from codesign_jax.engines.structured.kernel.rows import Record
from codesign_jax.engines.structured.kernel.shared_memory import TEAM
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import load, parameters
from codesign_jax.scene.schema import InputError
from tests.helpers import grasps, oracles
from tests.helpers.toy_engine import TINY

HELD = {"links": 3} | grasps.hurried(0.8, 1.3, 2.0, without="disturb ungrasp")


@functools.cache
def grasp_of(surface, *, finger_finger=False):
    """Scene, engine, inputs and trace of one grasp that lifts its box and drops it, float64."""
    effects = {"effects__surface": surface, "effects__finger_finger": finger_finger}
    scene = grasps.pinch("box", **effects, **HELD)
    with jax.enable_x64(True):
        engine = StructuredEngine(scene, iterations=100, tolerance=1e-24)
        hand, trial = grasps.hand_world(scene)
        trial = trial._replace(arm_tilt=np.array([0.02, -0.03]), yaw=np.array(0.1))
        fields, ctrl = grasps.world_inputs(scene, hand, trial)
        inputs = jax.tree.map(lambda v: np.asarray(v)[None], (fields, ctrl))
        run = jax.jit(partial(engine.recording(touch=True).rollout, trajectory=True))
        trace = jax.tree.map(np.asarray, run(*inputs))
    return scene, engine, inputs, trace


@pytest.fixture(scope="module", params=["spheres", "hull"])
def grasp(request):
    return grasp_of(request.param)


def test_forces_on_the_object_are_what_its_momentum_gains(grasp):
    scene, _, (fields, _), trace = grasp
    h = scene.discretization.timestep
    forces = trace.forces
    mass = fields.object_mass[0]
    # Places are those before each step, and a step ends with the velocity that it moves by.
    velocity = np.diff(trace.qpos[0, :, -7:-4], axis=0) / h
    gained = np.diff(velocity, axis=0) / h + [0, 0, scene.gravity]
    total = (forces.finger.sum(2) + forces.palm + forces.table)[0, 1:-1]
    # What 100 Newton iterations leave, of a weight of one newton.
    np.testing.assert_allclose(total, mass * gained, atol=1e-4 * mass * scene.gravity)
    assert forces.table[0, 60, 2] == pytest.approx(mass * scene.gravity, rel=1e-3)
    gripped = (forces.grip[0] > 0).any(1)
    assert gripped.sum() > 20 and forces.depth["finger_object"][0, gripped].max() > 1e-4


@pytest.mark.slow  # three kernels; quick: forces are what the momentum gains
def test_lanes_of_a_team_record_the_same_forces():
    """Which a GPU has, here on a CPU: beside those of single lanes, of every ring as well."""
    scene, _, (fields, ctrl), trace = grasp_of("hull", finger_finger=True)
    with jax.enable_x64(True):
        limits = StructuredEngine(scene, iterations=100, tolerance=1e-24).limits
        options = {"backend": "cpu", "width": 8, "team": TEAM, "record": Record(touch=True)}
        program = Program(scene, limits, **options)

        def run(fields, ctrl):
            hand = world_constants(scene, fields)
            out = program.execute(program.inputs(hand, reset(scene, fields), ctrl), trajectory=True)
            return forces.of_rollout(program, out, 1), program.outputs(out, 1)[0]["moved"]

        recorded, moved = jax.tree.map(np.asarray, jax.jit(run)(fields, ctrl))
    steps = moved[0] > 0
    assert steps.sum() > 100
    leaves = jax.tree.leaves(recorded), jax.tree.leaves(trace.forces)
    for got, expected in zip(*leaves, strict=True):
        # Sums in another order move a grasp of some hundred steps by some nanometres.
        np.testing.assert_allclose(got[0, steps], expected[0, steps], atol=1e-6)


def test_forces_of_the_rings_add_up(grasp):
    """To those of fingers and palm, which are what the object's momentum gains."""
    scene, _, _, trace = grasp
    forces = trace.forces
    for name, touch in forces.touch.items():
        pushed = touch.tangential - touch.pressing[..., None] * touch.normal
        expected = getattr(forces, name)
        # Sums of 16 forces in float64.
        np.testing.assert_allclose(pushed.sum(-2), expected, rtol=1e-10, atol=1e-12)
        across = (touch.tangential * touch.normal).sum(-1)
        np.testing.assert_allclose(across, 0.0, atol=1e-12)
        slipping = np.linalg.norm(touch.tangential, axis=-1)
        friction = scene.objects.object[0].friction
        assert (slipping <= friction * touch.pressing + 1e-9).all()
    grip = forces.touch["finger"].pressing
    np.testing.assert_allclose(grip.sum(-1), forces.grip, rtol=1e-10, atol=1e-12)
    assert (grip >= 0).all() and (grip > 0).any((0, 1, 2)).sum() > 1  # more than one ring


def test_forces_are_mujocos():
    """Of every contact, by its own solver, at the states and velocities of the path."""
    scene, engine, (fields, ctrl), trace = grasp_of("spheres")
    with jax.enable_x64(True):
        run = jax.jit(partial(engine.states, trajectory=True))
        states = jax.tree.map(np.asarray, run(fields, ctrl)[1])
    compiled = oracles.exact(scene, grasps.nth(fields, 0))
    data = mujoco.MjData(compiled)
    lay = model.layout(scene)
    touched = 0
    weight = fields.object_mass[0] * scene.gravity
    kinds = {body: ("finger", f) for f, row in enumerate(lay.bodies) for body in row}
    kinds |= {1: ("palm",), 0: ("table",)}
    geoms = lay.spheres.reshape(len(lay.spheres), -1)
    spheres = {int(geom): place for place, geom in np.ndenumerate(geoms)}
    for k in range(5, ctrl.shape[1], 7):
        data.qpos[:] = states["qpos"][0, k]
        data.qvel[:] = states["qvel"][0, k]
        data.ctrl[:] = ctrl[0, k]
        mujoco.mj_forward(compiled, data)
        forces = jax.tree.map(lambda v, k=k: v[0, k], trace.forces)
        sums = {"finger": np.zeros((2, 3)), "palm": np.zeros(3), "table": np.zeros(3)}
        rings = np.zeros_like(forces.touch["finger"].tangential)
        for i in range(data.ncon):
            contact = data.contact[i]
            force = np.zeros(6)
            mujoco.mj_contactForce(compiled, data, i, force)
            bodies = compiled.geom_bodyid[contact.geom]
            if lay.object in bodies:
                sign = 1 if bodies[1] == lay.object else -1  # the force on the second body
                kind, *index = kinds[int(bodies[bodies != lay.object][0])]
                acting = sign * contact.frame.reshape(3, 3).T @ force[:3]
                sums[kind][tuple(index)] += acting
                if kind == "finger":
                    ring = tuple(spheres[int(contact.geom[bodies != lay.object][0])])
                    rings[ring] += acting
                    point = forces.touch["finger"].point[ring]
                    np.testing.assert_allclose(point, contact.pos, atol=1e-10)  # rounding
        touched += data.ncon
        for name, expected in sums.items():
            np.testing.assert_allclose(getattr(forces, name), expected, atol=1e-6 * weight)
        touch = forces.touch["finger"]
        pushed = touch.tangential - touch.pressing[..., None] * touch.normal
        np.testing.assert_allclose(pushed, rings, atol=1e-6 * weight)
    assert touched > 100


def test_what_records_no_forces_is_refused():
    scene = grasps.short_grasp()
    world = grasps.hand_world(scene)
    with pytest.raises(InputError, match="engine mujoco records no forces"):
        simulate = partial(rollout.grasp, scene, make_engine("mujoco", scene), record_forces=True)
        jax.eval_shape(simulate, *world)
    engine = make_engine("structured", scene)

    def end(height):
        params = world[0]._replace(arm=world[0].arm + height)
        outcome = rollout.grasp(scene, engine, params, world[1], steps=3, record_forces=True)
        return outcome.height[-1]

    with pytest.raises(NotImplementedError, match="has no derivative"):
        jax.eval_shape(jax.grad(end), jnp.zeros(()))


@pytest.mark.slow  # 14 s; quick: forces are what the momentum gains
@pytest.mark.parametrize("text", ["down", "1,1,0"])
def test_a_pull_takes_the_object_as_mujocos_external_force_does(text):
    """Stepped by MuJoCo alone, with `xfrc_applied`; by engines that share no step; and too much."""
    off = ("finger_table", "palm_table", "palm_object")
    scene = load(TINY, overrides={f"effects.{name}": False for name in off})
    along = push.direction(text)
    space = parameters.design_space(scene.hand, "2d")
    hand = space.params(space.default())
    trials = jax.tree.map(lambda v: np.asarray(v)[None], rollout.nominal_trial(scene))
    pulls = [
        push.pull(scene, make_engine(n, scene), hand, trials, along)[0]
        for n in ("structured", "mujoco")
    ]
    expected = pulled_by_mujoco(scene, hand, trials, along)
    # A step of the pull, for rounding; float32 grips a little later.
    assert abs(pulls[1] - expected) < 1.5 * push.RATE * scene.discretization.timestep
    np.testing.assert_allclose(pulls[0], expected, rtol=0.15)
    assert pulls[0] > 1


def pulled_by_mujoco(scene, hand, trials, along):
    """The force [N] at which the object has left its place."""
    fields, ctrl = grasps.world_inputs(scene, hand, grasps.nth(trials, 0))
    compiled = world_model(scene, fields)
    lay = model.layout(scene)
    h = scene.discretization.timestep
    data = mujoco.MjData(compiled)
    count = int(scene.last_step("lift")) + 1
    data.qpos[:] = fields.start[: compiled.nq]

    def place():
        return data.qpos[-7:-4] - data.qpos[:3]

    force = 0.0
    for k in range(10_000):
        if k == count:
            first = place()
        if k > count and np.linalg.norm(place() - first) > push.OUT:
            return force
        force = push.RATE * h * max(0, k - count + 1)
        data.ctrl[:] = ctrl[min(k, count - 1)]
        data.xfrc_applied[lay.object, :3] = force * along
        mujoco.mj_step(compiled, data)
    return np.inf


def test_what_cannot_be_pulled_is_said():
    assert push.in_words(np.nan).startswith("not held")
    assert "more than 50 N" in push.in_words(np.inf)


@pytest.mark.slow  # a kernel; quick: what is recorded, and that wrong pulls are refused
def test_a_table_of_forces_has_each_step(tmp_path, capsys):
    path = tmp_path / "forces.csv"
    assert cli.main(["evaluate", "--scene", str(TINY), "--trials", "1", "--forces", str(path)]) == 0
    output = capsys.readouterr().out
    assert re.search(r"sphere: grip [\d.e-]+ \+ [\d.e-]+ N by finger", output) and " mm" in output
    scene = load(TINY)
    rows = [*csv.DictReader(path.read_text().splitlines())]
    assert len(rows) == scene.num_steps and rows[-1]["object"] == "sphere"
    row = rows[int(scene.last_step("lift"))]
    push_up = sum(float(row[f"finger_{i}_z_N"]) for i in (0, 1)) + float(row["palm_z_N"])
    # Carried, in the last step of the lift; the trial's object has 15 % of noise in its mass.
    assert push_up == pytest.approx(scene.gravity * scene.objects.object[0].mass, rel=0.5)
    assert float(row["table_z_N"]) == 0 and float(row["depth_finger_object_mm"]) > 0
