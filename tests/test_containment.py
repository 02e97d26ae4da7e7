"""Status bits, saved failures, bad starts and mounts; neighbours of failing worlds: test_kernel."""

import dataclasses
import itertools
import re
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import cli, model, preflight, rollout, runs, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.model.clearance import starts_apart
from codesign_jax.runs.run import Run
from codesign_jax.types import Status
from tests.helpers.grasps import (
    batch_inputs,
    hand_world,
    hurried,
    nth,
    outcome,
    pinch,
    random_worlds,
    stack,
    still,
)
from tests.helpers.toy_engine import TINY

HURRIED = {"links": 2} | hurried(0.3, 0.5, 0.7, 0.9, 1.5)


def one_world(the_scene):
    """Fields and controls of one world."""
    return batch_inputs(the_scene, *(stack(v) for v in hand_world(the_scene)))


def test_mujoco_tells_when_its_solver_stops_at_the_cap():
    """The resting box needs more than one iteration in its first step."""
    for iterations, capped in ((1, True), (30, False)):
        the_scene = pinch("box", solver__iterations=iterations, **HURRIED)
        trace = MujocoEngine(the_scene).rollout(*one_world(the_scene))
        assert bool((np.asarray(trace.status) == Status.SOLVER_CAP).any()) == capped


def test_mujoco_tells_when_its_contacts_do_not_fit(monkeypatch, tmp_path, capfd):
    """With an arena of 20 kB the box's contacts with the table have no room.

    MuJoCo leaves them out or gives up, by how much is missing; the batch goes on either way.
    """
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning there
    the_scene = pinch("box", **HURRIED)
    engine = MujocoEngine(the_scene)
    spec = model.build_spec(the_scene, *hand_world(the_scene))
    spec.memory = 20_000
    engine.template = spec.compile()
    trace = engine.rollout(*one_world(the_scene))
    result = outcome(the_scene, nth(trace, 0))
    assert result.status & Status.CONTACT_OVERFLOW and 0 <= result.bad_step <= 25
    assert result.cost == the_scene.cost.maximum
    capfd.readouterr()


def test_bad_starts_are_flagged_and_in_the_outcome():
    """Of worlds that start with the palm at 150 mm."""
    the_scene = pinch("box", arm__start_height=0.15)
    base, _ = hand_world(the_scene, length=0.08)
    changes = (
        {},
        {"length": 0.18},  # straight fingers, 75 degrees down: 24 mm into the table
        {"length": np.nan},
        {"wall": 0.0},  # neither mass nor stiffness
        {"length": -0.05},
        {"wall": 0.02},  # walls thicker than the section
    )
    worlds = [base._replace(**{k: 0 * base.length + v for k, v in c.items()}) for c in changes]
    trials = stack(*[still()] * len(worlds))
    fields, _ = batch_inputs(the_scene, stack(*worlds), trials)
    flags = jax.jit(partial(preflight.invalid_start, the_scene))(fields)
    bad = [False, True, True, True, True, True]
    np.testing.assert_array_equal(np.asarray(flags) != 0, bad)
    engine = MujocoEngine(the_scene)
    few = slice(2)
    run = jax.jit(lambda p, t: rollout.simulate(the_scene, engine, p, t)[0])
    result = run(stack(*worlds[few]), nth(trials, few))
    assert [bool(s & Status.INVALID_START) for s in result.status] == bad[few]


# The kernel's own last good state: test_kernel.
@pytest.fixture(
    scope="module", params=["mujoco", pytest.param("structured", marks=pytest.mark.slow)]
)
def failing_run(request, tmp_path_factory):
    """A tiny optimisation in which some trials are too fast."""
    save = Run.save

    def without_devices(run):
        # They simulate the next episode: what is given to them would wait for its end.
        with jax.transfer_guard_host_to_device("disallow_explicit"):
            save(run)

    folder = tmp_path_factory.mktemp("failing") / "run"
    sizes = ["--particles", "3", "--trials", "2", "--episodes", "1", "--test-trials", "0"]
    run = [
        "optimize",
        "--scene",
        str(TINY),
        "--engine",
        request.param,
        "--out",
        str(folder),
        *sizes,
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "save", without_devices)
        cli.main([*run, "--set", "limits.speed=12"])
    return folder


def test_failed_worlds_are_saved_and_replayed(failing_run, capsys):
    """The saved state is the last good one, and the replay fails alike, at the same step."""
    folder = failing_run
    scene, _ = runs.read_run(folder)
    files = sorted((folder / "failures").glob("*.npz"))
    assert files
    saved = runs.failures.load(files[0])
    state = model.split(scene, saved.state)
    assert saved.status & Status.SPEED and saved.bad_step > 0
    assert np.abs(state.qvel).max() <= scene.limits.speed
    assert cli.main(["replay", str(files[0])]) == 0
    text = capsys.readouterr().out
    recorded, again = (line for line in text.splitlines() if "first bad step" in line)
    assert recorded.split(": ")[1] == again.split(": ")[1]
    steps = re.findall(r"step \d+: speed (\S+), object", text)
    assert float(steps[-1]) > scene.limits.speed >= float(steps[-2])


def test_all_failed_stops_with_a_diagnosis(tmp_path, capsys):
    folder = tmp_path / "run"
    sizes = ["--particles", "3", "--trials", "2", "--episodes", "2", "--test-trials", "0"]
    flags = ["--scene", str(TINY), "--engine", "mujoco", "--out", str(folder)]
    arguments = ["optimize", *flags, *sizes]
    assert cli.main([*arguments, "--set", "limits.speed=1"]) == 1
    message = capsys.readouterr().err
    assert "every one of 6 trials failed (SPEED 6)" in message
    assert "discretization.timestep" in message and "codesign replay" in message
    # However often it is started: no episode is added, and none of its designs is praised.
    for _ in range(2):
        assert cli.main([*arguments, "--set", "limits.speed=1"]) == 1
        assert "every one of 6 trials failed (SPEED 6)" in capsys.readouterr().err
    assert len((folder / "episodes.csv").read_text().splitlines()) == 2
    assert cli.main(["evaluate", str(folder), "--dry-run"]) == 0
    doubt = "every trial of the run's chosen design failed (SPEED 2)"
    assert doubt in capsys.readouterr().err
    assert cli.main(["export", str(folder), "--out", str(tmp_path / "models")]) == 2
    assert "Nothing is exported" in capsys.readouterr().err and not (tmp_path / "models").exists()


# --- what is refused before anything is simulated; mounts of fingers ------------------------------


def hands(scene, count):
    """Random hands of the whole table, NumPy arrays in float64 with leading axis (world,)."""
    params, _ = random_worlds(scene, 0, count)
    return jax.tree.map(lambda v: np.asarray(v, float), params)


def deepest(compiled, data, geoms, others):
    """Deepest overlap [m] of a geom with one of the others' by MuJoCo C."""
    pairs = itertools.product(geoms, others)
    return -min(mujoco.mj_geomDistance(compiled, data, a, b, 1.0, None) for a, b in pairs)


@pytest.mark.slow  # 7 s
def test_fingers_and_palm_are_as_deep_in_one_another_as_mujocos_geoms():
    """By `preflight`, of hands with a sphere a link and a finger that is mounted into the palm."""
    effects = {"finger_finger": True, "finger_palm": True}
    sizes = {"links": 3, "spheres_per_link": 1}
    changes = {"effects": effects, "discretization": sizes, "limits": {"penetration": 0.002}}
    the_scene = scene.load("paper_spheres", overrides=changes)
    inwards = dataclasses.replace(the_scene.hand.finger[0], azimuth=180.0, tilt=-20.0)
    mounted = dataclasses.replace(the_scene.hand, finger=(inwards, *the_scene.hand.finger[1:]))
    the_scene = dataclasses.replace(the_scene, hand=mounted)
    designs = hands(the_scene, 6)

    @jax.jit
    def of_engines(designs):
        fields = jax.vmap(lambda p: model.model_fields(the_scene, p, still()))(designs)
        tests = preflight.depth_between, preflight.depth_in_palm, preflight.invalid_start
        return fields.start, *(test(the_scene, fields) for test in tests)

    with jax.enable_x64(True):
        places, between, palm, invalid = map(np.asarray, of_engines(designs))
    for i in range(len(places)):
        design = jax.tree.map(lambda v, i=i: v[i], designs)
        compiled = model.compile_model(the_scene, design, still())
        data = mujoco.MjData(compiled)
        data.qpos[:] = places[i]
        mujoco.mj_kinematics(compiled, data)
        name = "finger_{}_sphere_{}_0".format
        fingers = [[compiled.geom(name(f, k)).id for k in (1, 2, 3)] for f in range(4)]
        pairs = itertools.combinations(fingers, 2)
        # MuJoCo's own iteration for a sphere and a cylinder ends at 1e-6.
        depth = max(deepest(compiled, data, a, b) for a, b in pairs)
        assert between[i] == pytest.approx(depth, abs=1e-6)
        disc = [compiled.geom("palm_disc").id]
        # Joints are at 1/6, 1/2 and 5/6 of the length, spheres in the middles behind them.
        along = np.outer(design.length, [1 / 3, 2 / 3, 11 / 12])
        beyond = (along >= design.height[:, None]) & (along >= design.length[:, None] / 4)
        free = [np.array(geoms)[far] for geoms, far in zip(fingers, beyond, strict=True)]
        depth = max(deepest(compiled, data, geoms, disc) for geoms in free if len(geoms))
        assert palm[i] == pytest.approx(depth, abs=1e-6)
    deep = np.maximum(between, palm) > 0.002
    assert 0 < deep.sum() and palm.max() > 0.002
    np.testing.assert_array_equal(invalid != 0, deep)
    messages = preflight.refusals(the_scene, designs, [*map(str, range(len(deep)))])
    assert {line.split(":")[0] for line in messages} == {str(i) for i in np.flatnonzero(deep)}


@pytest.mark.parametrize(
    ("height", "bodies"),
    [
        (0.3, set()),
        (0.06, {"finger 0 in the table", "finger 0 in object 'box'"}),
    ],
)
def test_bodies_that_keep_a_grasp_from_starting_are_named_with_a_remedy(height, bodies):
    """A hand straight above a box; the height that the remedy names is one from which it starts."""
    the_scene = pinch("box", arm__start_height=height)
    design, trial = hand_world(the_scene)
    texts = preflight.why_invalid(the_scene, design, trial)
    assert bool(texts) == bool(bodies)
    if texts:
        assert any(name in texts[0] for name in bodies), texts
        [remedy] = re.findall(r"arm.start_height=([0-9.]+)", texts[0])
        higher = pinch("box", arm__start_height=float(remedy))
        assert preflight.why_invalid(higher, design, trial) == []


@pytest.mark.slow  # 9 s
def test_straight_fingers_rest_beside_the_palm():
    """Of any length, by the rings that press; a finger that is mounted into the palm is refused.

    Where a quarter of the length alone was kept off the palm, a third of such hands pressed on it
    at rest, by up to 6.3 mm.
    """
    the_scene = scene.load("paper")
    designs = hands(the_scene, 100)
    short = np.random.default_rng(5).uniform(0.010, 0.030, designs.length.shape)
    designs = designs._replace(length=np.where(np.arange(100)[:, None] < 50, short, designs.length))
    inwards = dataclasses.replace(the_scene.hand.finger[0], azimuth=180.0, tilt=-20.0)
    mounted = dataclasses.replace(the_scene.hand, finger=(inwards, *the_scene.hand.finger[1:]))
    mounted = dataclasses.replace(the_scene, hand=mounted)

    @jax.jit
    def depths(numbers, designs):
        fields = jax.vmap(lambda p: model.model_fields(numbers, p, still()))(designs)
        scenes = the_scene.structure, fields
        return preflight.depth_in_palm(*scenes), preflight.invalid_start(*scenes)

    with jax.enable_x64(True):
        rest, into = (jax.tree.map(np.asarray, depths(s, designs)) for s in (the_scene, mounted))
    assert rest[0].max() < -5e-3  # farther than a step's candidates
    # Not where the finger is shorter than it is high: it touches no palm.
    assert into[0][designs.length[:, 0] > designs.height[:, 0] + 0.02].min() > 4e-3
    deep = into[0] > the_scene.limits.penetration
    assert deep.sum() > 10 and into[1][deep].all()


@pytest.mark.slow  # 8 s; quick: the kernel's overlaps below, and a refusal (test_steps)
@pytest.mark.parametrize("surface", ["hull", "spheres"])
def test_fingers_inside_one_another_are_refused(surface):
    """Without a spread two pairs of the paper's fingers stand in one place: 20 mm deep."""
    effects = {"surface": surface, "finger_finger": True}
    the_scene = scene.load("paper_spheres", overrides={"effects": effects})
    both = [hand_world(the_scene, spread=np.deg2rad(x))[0] for x in (0.0, 60.0)]
    designs = jax.tree.map(lambda *v: np.stack(v), *both)
    refusals = preflight.refusals(the_scene, designs, ["together", "apart"])
    assert len(refusals) == 1 and refusals[0].startswith(
        "together: fingers start 20 mm inside one another (limits.penetration = 10 mm)"
    )


@pytest.mark.parametrize(
    "surface", ["hull", *(pytest.param(n, marks=pytest.mark.slow) for n in ("spheres", "grown"))]
)
def test_the_kernel_finds_the_overlaps_of_a_start(surface):
    """As `preflight` does: with table and object, of fingers in the palm, and in one another.

    Grown: of rings that are as large as the pressure of the first key frame makes them.
    """
    grown = surface == "grown"
    effects = {"surface": "hull" if grown else surface, "section_growth": grown}
    effects |= {"finger_finger": True, "finger_palm": True}
    sizes = {"arm": {"start_height": 0.14}, "discretization": {"links": 3}, "effects": effects}
    sizes |= {"control": {"frame": {"0": {"pressure": "pressure"}}}} if grown else {}
    the_scene = scene.load("paper_spheres", overrides=sizes)
    inwards = dataclasses.replace(the_scene.hand.finger[0], azimuth=180.0, tilt=-20.0)
    mounted = dataclasses.replace(the_scene.hand, finger=(inwards, *the_scene.hand.finger[1:]))
    the_scene = dataclasses.replace(the_scene, hand=mounted)
    count = 30
    designs, trials = random_worlds(the_scene, 0, count)
    third = np.arange(count) % 3
    designs = designs._replace(
        length=np.where(third[:, None] == 0, designs.length, 0.07).astype(np.float32),
        spread=np.where(third == 1, 0.0, 1.0).astype(np.float32),
    )
    engine = make_engine("structured", the_scene)

    @jax.jit
    def overlaps(designs, trials):
        fields, ctrl = rollout.prepare(the_scene, designs, trials)
        tests = preflight.depth, preflight.depth_between, preflight.depth_in_palm
        depths = [test(the_scene.structure, fields) for test in tests]
        trace = engine.rollout(fields, ctrl[:, :2])
        flags = preflight.invalid_start(the_scene, fields, trace.overlap)
        start = rollout.decided(the_scene, fields.start, third > 0)
        filled = engine.rollout(fields._replace(start=start), ctrl[:, :2])
        ends = trace.last, filled.last, fields.qpos
        return trace.overlap, jnp.stack(depths), flags, *ends

    results = map(np.asarray, overlaps(designs, trials))
    by_kernel, depths, flags, last, last_of_filled, places = results
    deepest = np.maximum(depths.max(0), 0.0)
    np.testing.assert_allclose(by_kernel, deepest, atol=1e-6)  # m; rounding in float32
    refused = deepest > the_scene.limits.penetration
    np.testing.assert_array_equal(flags == Status.INVALID_START, refused)
    assert {*depths.argmax(0)[deepest > 0]} == {0, 1, 2} and 0 < refused.sum() < count
    # Bounds that compile nothing call no hand apart that is refused, low or high over the table.
    high = dataclasses.replace(the_scene.arm, start_height=0.4)
    raised = dataclasses.replace(the_scene, arm=high)
    of_hand = depths[1:].max(0) > the_scene.limits.penetration
    for where, wrong in ((the_scene, refused), (raised, of_hand)):
        apart = np.array([starts_apart(where, nth(designs, k)) for k in range(count)])
        assert wrong.any() and not (apart & wrong).any()
    usual = scene.load("paper_spheres", overrides={"effects": effects})
    assert starts_apart(usual, hand_world(usual)[0])
    # Worlds that fill a batch up stay where they are, and the others do not notice them.
    np.testing.assert_array_equal(last_of_filled[third == 0], last[third == 0])
    stay = last_of_filled[third > 0, : places.shape[1]]
    np.testing.assert_array_equal(stay, places[third > 0])
    assert (last[third > 0, : places.shape[1]] != places[third > 0]).any(1).all()


@pytest.mark.parametrize("spread", [0.0, 1.1])
def test_base_points_stay_and_directions_turn(spread):
    """Place and direction of a finger from MuJoCo's kinematics, against the file's numbers."""
    effects = {"surface": "spheres", "finger_finger": False}
    overrides = {"discretization.links": 1, "effects": effects}  # straight fingers are one box
    the_scene = scene.load("paper", overrides=overrides)
    params, trial = hand_world(the_scene, spread=spread)
    compiled = model.compile_model(the_scene, params, trial)
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    to_palm = data.body("palm").xmat.reshape(3, 3).T
    for i, finger in enumerate(the_scene.hand.finger):
        root = data.body(f"finger_{i}_link_0")
        place = to_palm @ (root.xpos - data.body("palm").xpos)
        assert finger.base is not None
        np.testing.assert_allclose(place, [*finger.base, 0.0], atol=1e-9)
        azimuth = np.deg2rad(finger.azimuth) + finger.spread * spread
        tilt = np.deg2rad(finger.tilt)
        level = np.cos(tilt) * np.array([np.cos(azimuth), np.sin(azimuth)])
        along = to_palm @ root.xmat.reshape(3, 3)[:, 0]
        np.testing.assert_allclose(along, [*level, -np.sin(tilt)], atol=1e-9)
