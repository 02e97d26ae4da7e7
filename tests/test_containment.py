"""Status bits, saved failures and their replay; neighbours of failing worlds: test_kernel."""

import re
from functools import partial

import jax
import numpy as np
import pytest

from codesign_jax import cli, model, rollout, runs, start
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.types import Status
from tests.helpers.grasps import (
    batch_inputs,
    hand_world,
    hurried,
    nth,
    outcome,
    pinch,
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
    found = jax.jit(partial(start.invalid_start, the_scene))(fields)
    bad = [False, True, True, True, True, True]
    np.testing.assert_array_equal(np.asarray(found) != 0, bad)
    engine, few = MujocoEngine(the_scene), slice(2)
    run = jax.jit(lambda p, t: rollout.simulate(the_scene, engine, p, t)[0])
    result = run(stack(*worlds[few]), nth(trials, few))
    assert [bool(s & Status.INVALID_START) for s in result.status] == bad[few]


# --- runs ------------------------------------------------------------------------------------


# The kernel's own last good state: test_kernel.
@pytest.fixture(
    scope="module", params=["mujoco", pytest.param("structured", marks=pytest.mark.slow)]
)
def failing_run(request, tmp_path_factory):
    """A tiny optimisation in which some trials are too fast."""
    save = runs.loop.Loop.save

    def without_devices(loop):
        # They simulate the next episode: what is given to them would wait for its end.
        with jax.transfer_guard_host_to_device("disallow_explicit"):
            save(loop)

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
        patch.setattr(runs.loop.Loop, "save", without_devices)
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
    own = ["--scene", str(TINY), "--engine", "mujoco", "--out", str(folder)]
    arguments = ["optimize", *own, *sizes]
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
