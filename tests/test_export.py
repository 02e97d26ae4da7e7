"""Exported grasps: plain MuJoCo simulates the files as the engine `mujoco` does."""

import csv
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import rollout, scene
from codesign_jax.cost import outcome
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.engines.structured.kernel import memory_tables
from codesign_jax.export import grasps, plain, skin, tables
from codesign_jax.export.play import play
from codesign_jax.model import build_spec
from codesign_jax.scene import parameters
from tests.helpers.command_runs import command
from tests.helpers.grasps import (
    batch_inputs,
    hand_world,
    hurried,
    lanes,
    nth,
    pinch,
    repeat,
    stack,
    world_inputs,
)
from tests.helpers.solids import object_file
from tests.helpers.toy_engine import TINY

ROOT = Path(__file__).parent.parent

# A grasp in 2.2 s, with all joints and contacts.
HURRIED = hurried(0.5, 0.8, 1.2, 1.6, 2.2)


def by_engine(the_scene, params, trials):
    """Trace and outcomes of the engine `mujoco` in float64."""
    with jax.enable_x64(True):
        inputs = jax.tree.map(np.asarray, batch_inputs(the_scene, params, trials))
        trace = MujocoEngine(the_scene).rollout(*inputs, trajectory=True)
        judged = jax.jit(jax.vmap(lambda t: outcome(the_scene, t)))(trace)
        return jax.tree.map(np.asarray, (trace, judged))


@pytest.fixture(scope="module")
def grasped():
    """A scene and three grasps: one that holds, one with every noise, one of slack fingers."""
    the_scene = pinch("box", **HURRIED)
    arm = np.array([0, 0, 0.03, 0, 0, 0])
    holding, still = hand_world(the_scene, length=0.10, pressure=1.9e5)
    holding = holding._replace(arm=arm)
    noisy = still._replace(
        position=np.array([0.004, -0.003]),
        arm_tilt=np.array([0.05, -0.03]),
        mass=np.array(1.1),
        size=np.array(0.95),
        friction=np.array(1.2),
        stiffness=np.array(0.9),
        hand_mass=np.array(1.1),
    )
    slack = holding._replace(pressure=0.1 * holding.pressure)
    worlds = [(holding, still), (holding, noisy), (slack, still)]
    with jax.enable_x64(True):
        params, trials = stack(*worlds)
    trace, judged = by_engine(the_scene, params, trials)
    return the_scene, worlds, trace, judged


def read(path):
    """Rows of a table."""
    return list(csv.DictReader(path.read_text().splitlines()))


def errors(states, trace, index):
    """Largest difference of a generalized position in each step [m or rad]."""
    return np.abs(states[:, : trace.qpos.shape[2]] - trace.qpos[index]).max(1)


def test_plain_mujoco_plays_the_files_as_the_engine(grasped, tmp_path):
    the_scene, worlds, trace, judged = grasped
    assert np.isinf(judged.lost_time).tolist() == [True, False, False]
    found = [grasps.grasp(the_scene, *world) for world in worlds]
    trials = [(f"grasp_{i}", trial) for i, (_, trial) in enumerate(worlds)]
    list(tables.write_grasps(tmp_path, the_scene, trials, found))
    for i, (name, _) in enumerate(trials):
        controls = np.loadtxt(tmp_path / f"{name}_controls.csv", delimiter=",", skiprows=1)
        xml = mujoco.MjModel.from_xml_path(str(tmp_path / f"{name}.xml"))
        binary = mujoco.MjModel.from_binary_path(str(tmp_path / f"{name}.mjb"))
        for loaded in (xml, binary):
            when, _, states = play(loaded, controls)
            assert when == judged.lost_time[i]
            # Rounding of 1e-16 grows while fingers slide on the sphere, here to 1e-11.
            assert errors(states, trace, i).max() < 1e-7
        assert found[i].outcome.status == judged.status[i] & ~8  # plain MuJoCo tells no warnings


def assert_declared(alone, spec, shares):
    """K I, B and R of every constraint row, in the file and in the model with declared weights.

    In a state with many contacts; the normal's stiffness k_n = K I / R is the declared one of two
    bodies, twice as large at the table, times the share of a sphere on a finger.
    """
    rows = []
    declared = plain.engine_model(alone, spec, shares)
    for model in (declared, mujoco.MjModel.from_xml_string(plain.text(alone, spec.copy(), shares))):
        data = mujoco.MjData(model)
        # Palm, straight fingers, object and table are in one another.
        data.qpos[2], data.qpos[-7:-4] = 0.005, [0.03, 0, 0.02]
        mujoco.mj_forward(model, data)
        k, b, impedance = data.efc_KBIP[:, :3].T
        rows.append(np.stack([k * impedance, b, data.efc_R]))
    assert rows[0].shape[1] > 10
    np.testing.assert_allclose(rows[1], rows[0], rtol=1e-10)  # rounding
    stiffness, touching = rows[0][0] / rows[0][2], 0
    for contact in data.contact:
        names = [model.geom(g).name for g in contact.geom]
        share = min(shares.get(name, 1.0) for name in names)
        expected = share * alone.contact.normal_stiffness * 2 / (1 if "table" in names else 2)
        assert stiffness[contact.efc_address] == pytest.approx(expected, rel=1e-9)
        touching += share < 1
    assert touching > 2 or not shares


@pytest.mark.parametrize("friction", ["none", "coulomb", "full"])
def test_contacts_have_the_declared_stiffness(friction):
    the_scene = pinch("box", effects__friction=friction, effects__finger_finger=True)
    params, trial = hand_world(the_scene)
    alone, trial = plain.single_object(the_scene, trial)
    assert_declared(alone, build_spec(alone, params, trial), {})


@pytest.fixture(scope="module")
def skinned():
    """A scene with the hull, contact between fingers and one object, a hand, and its spec."""
    the_scene = pinch(
        "box", links=2, effects__surface="hull", effects__finger_finger=True, **HURRIED
    )
    params, trial = hand_world(the_scene, length=0.08)
    alone, trial = plain.single_object(the_scene, trial)
    spec = build_spec(alone, params, trial)
    return alone, params, trial, spec, skin.add(alone, spec, params)


def test_spheres_stand_where_the_engine_has_its_rings(skinned):
    """In the engine's own table of rings; their shares are the finger's length in widths."""
    alone, params, trial, _, shares = skinned
    fields, _ = world_inputs(alone, params, trial)
    hand = lanes(alone, repeat(fields, 1))
    rings = np.asarray(memory_tables.ring_numbers(alone, hand, 2))[:, :, 1, 0]
    segment = params.length[1] / alone.discretization.links
    found = skin.balls(alone, 1, params)
    np.testing.assert_allclose([b.place for b in found], rings[:, :3], atol=1e-6)
    np.testing.assert_allclose([b.share for b in found], rings[:, 6], rtol=1e-5)
    total = sum(share for name, share in shares.items() if name.startswith("finger_1"))
    length = params.length[1] - segment / 2  # the half link at the palm is the palm's
    assert total == pytest.approx(length / alone.hand.section.width)


def test_a_sphere_is_as_stiff_as_its_share_of_the_finger(skinned):
    alone, _, _, spec, shares = skinned
    assert_declared(alone, spec, shares)


def test_commands_are_the_key_frames(tmp_path):
    the_scene = scene.load("paper_spheres")
    space = parameters.design_space(the_scene.hand, "2d")
    with jax.enable_x64(True):
        design = nth(space.params(space.default()), ...)
    schedule = grasps.timed_controls(the_scene, design, rollout.nominal_trial(the_scene))
    tables.write_commands(tmp_path, the_scene, schedule)
    rows = read(tmp_path / tables.COMMANDS)
    head = [*tables.COMMAND_COLUMNS, *(f"pressure_{i}_kPa" for i in (1, 2, 3))]
    assert [*rows[0]] == head and len(rows) == 900
    at = {row["time_s"]: {k: v for k, v in row.items() if k != "phase"} for row in rows}
    values = {t: {k: float(v) for k, v in row.items()} for t, row in at.items()}
    top, grasp = 300, 60 + float(1e3 * design.arm[2])  # mm, as in the scene file
    heights = {"0": top, "1": (top + grasp) / 2, "2": grasp, "4.5": top}
    for time, height in heights.items():
        assert values[time]["arm_z_mm"] == pytest.approx(height, rel=1e-6)
    assert values["2.75"]["pressure_3_kPa"] == pytest.approx(60, abs=1e-4)
    assert values["0"]["arm_pitch_deg"] == pytest.approx(-15, rel=1e-6)
    phase = {row["time_s"]: row["phase"] for row in rows}
    assert [phase[t] for t in ("1.99", "2", "4.49")] == ["approach", "inflate", "lift"]


# --- the command ---------------------------------------------------------------------------------


def test_command_writes_models_of_the_default_scene_s_kind(tmp_path, capsys):
    """Hull, effects that plain MuJoCo does not have, and a mesh: models without them, and notes."""
    out = tmp_path / "out"
    own = ["effects.surface=hull", "effects.finger_finger=true", "effects.friction_memory=true"]
    mug = 'name = "mug"; type = "mesh"; unit = "mm"; mass = 0.1; friction = 0.8; '
    mesh = object_file(tmp_path, f'{mug}file = "{ROOT / "objects" / "household" / "mug.stl"}"')
    own += ["effects.neo_hookean=true", "--objects", mesh]
    arguments = ["--scene", TINY, "--out", out, "--no-parts", "--no-sheet", "--set", *own]
    assert command("export", *arguments) == 0
    said = capsys.readouterr().out
    notes = (out / "model" / "README.txt").read_text()
    for words in ("without effects.neo_hookean", "without effects.friction_memory", "mesh 'mug'"):
        assert f"note: the model {'has the ' * ('mesh' in words)}" in said
        assert words in said and words in notes
    [mug] = scene.load("paper", object_set=mesh).objects.object
    loaded = mujoco.MjModel.from_xml_path(str(out / "model" / "mug.xml"))
    data = mujoco.MjData(loaded)
    mujoco.mj_resetDataKeyframe(loaded, data, 0)
    mujoco.mj_kinematics(loaded, data)
    # The file's vertices stand in the world where the mesh's do, in the orientation of the start.
    turn, place = data.body("object").xmat.reshape(3, 3), data.body("object").xpos
    geom = data.geom("object_0")
    vertices = loaded.mesh_vert @ geom.xmat.reshape(3, 3).T + geom.xpos
    np.testing.assert_allclose(vertices, mug.mesh.vertices @ turn.T + place, atol=1e-7)  # float32
