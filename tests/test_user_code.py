"""`--optimizer module:Class` and `--cost module:function`: what runs do with a user's own code."""

import json
import shutil
import sys

import numpy as np
import pytest

from codesign_jax import cli, preflight, runs, user_code
from tests.helpers.command_runs import assert_same_run, snapshot
from tests.helpers.refusals import refusal_of_command
from tests.helpers.toy_engine import TINY

MINE = '''
import dataclasses

import jax
import jax.numpy as jnp

from codesign_jax.optimize import Space, OptimizerState
from codesign_jax.optimize.protocol import episode_key, summarize

no_function = 3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Climber:
    """Moves the best design so far."""

    keeps_best = True
    space: Space

    def init(self, key, seed_particle, num_particles):
        seed = jnp.asarray(seed_particle, float)
        memory = {"best": seed, "cost": jnp.inf * jnp.ones(())}
        return OptimizerState(jnp.tile(seed, (num_particles, 1)), jnp.int32(0), key, memory)

    def ask(self, state, mask):
        low, high = jnp.asarray(self.space.low), jnp.asarray(self.space.high)
        noise = jax.random.normal(episode_key(state, 1), state.particles.shape)
        moved = jnp.clip(state.memory["best"] + 0.2 * (high - low) * noise, low, high)
        return jnp.where(mask, moved, state.particles)

    def tell(self, state, population, cost, mask=True):
        best = jnp.argmin(cost)
        better = cost[best] < state.memory["cost"]
        memory = {
            "best": jnp.where(better, population[best], state.memory["best"]),
            "cost": jnp.minimum(cost[best], state.memory["cost"]),
        }
        order = jnp.argsort(cost).astype(jnp.int32)
        new = OptimizerState(population[order], state.episode + 1, state.key, memory)
        return new, summarize(cost, jnp.ones_like(cost), order)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Forgetful(Climber):
    def tell(self, state, population, cost, mask=True):
        new, info = Climber.tell(self, state, population, cost, mask)
        return new._replace(memory=None), info


def low(scene, trace, ctrl):
    """Depth below 0.2 m at the end of the shaking, and the way of the lift [m]."""
    lift = ctrl[:, 2].max() - ctrl[:, 2].min()
    return jnp.abs(0.2 - trace.at(scene, "disturb").height) + lift


def late(carry, seen):
    return carry, seen.plan._replace(pressure=jnp.where(seen.phase > 0, 80.0, 0.0) + jnp.zeros(2))


class Pull:
    """Moves the hand aside by a searched share of a metre, once fingers move."""

    period = 0.1
    parameters = [{"name": "share", "unit": "1", "low": 0.0, "high": 1.0, "default": 0.3}]

    def __init__(self, scene):
        self.fingers = scene.num_fingers

    def init(self, params):
        return params.control["share"]

    def __call__(self, share, seen):
        moving = jnp.abs(seen.joint_velocity).max() > 0.1
        pose = seen.plan.pose[0].at[0].add(jnp.where(moving, share, 0.0))
        return share, seen.plan._replace(pose=pose)


class Narrow(Pull):
    def __call__(self, share, seen):
        return share, seen.plan._replace(pressure=jnp.zeros(7))


def until_lost(scene, trace, ctrl):
    return trace.distance.mean()


until_lost.stop_when_lost = True


def gripped(scene, trace, ctrl):
    """Less for a harder grip [N]."""
    return 1.0 + jnp.exp(-trace.forces.grip.max())


gripped.record_forces = True


def unrecorded(scene, trace, ctrl):
    return trace.forces.grip.max()


def series(scene, trace, ctrl):
    return trace.distance
'''
RUN = [
    *("optimize", "--scene", str(TINY), "--particles", "4", "--trials", "3", "--test-trials", "2"),
    # On MuJoCo C: the kernel makes no difference to the rules here, and takes longer to compile.
    *("--engine", "mujoco", "--reference-trials", "0", "--seed", "3"),
]
OWN = [*RUN, "--optimizer", "mine:Climber", "--cost", "mine:low"]


@pytest.fixture
def workdir(tmp_path, monkeypatch):
    """A working directory with a module of the user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    monkeypatch.setattr(preflight, "refusals", lambda *rest: [])  # which compiles
    (tmp_path / "mine.py").write_text(MINE)
    before = [*sys.path]
    yield tmp_path
    assert sys.path == before
    sys.modules.pop("mine", None)


@pytest.mark.slow  # 16 s; quick: test_resume
def test_a_run_of_ones_own_code_goes_on_bit_for_bit(workdir, capsys):
    for episodes, folder in (("2", "whole"), ("1", "grown"), ("2", "grown")):
        assert cli.main([*OWN, "--episodes", episodes, "--out", folder]) == 0
    assert_same_run(workdir / "grown", workdir / "whole")
    output = capsys.readouterr().out
    assert (
        "lowest mean cost of an episode, by mine:low" in output and "converged from" not in output
    )
    assert (workdir / "grown" / "code" / "mine.py").read_text() == MINE
    noted = json.loads((workdir / "grown" / "provenance.json").read_text())
    assert [noted["settings"][name] for name in ("optimizer", "cost")] == OWN[-3::2]
    record = runs.load_record(workdir / "grown")
    assert record is not None and np.ptp(record.history.outcomes.cost[1]) > 0.01


def test_a_cost_of_forces_asks_for_them_of_an_engine_that_has_them(workdir):
    problems = refusal_of_command(*RUN, "--cost", "mine:gripped", "--out", "run")
    assert problems == [("unsupported", "")]
    problems = refusal_of_command(*RUN, "--cost", "mine:unrecorded", "--out", "run")
    assert problems == [("user_code", "--cost mine")]


@pytest.mark.slow  # a kernel; quick: forces are recorded (test_forces), and the refusals above
def test_a_cost_reads_forces_if_it_asks_for_them(workdir):
    sizes = ["--particles", "2", "--trials", "1", "--test-trials", "0", "--reference-trials", "0"]
    run = ["optimize", "--scene", str(TINY), *sizes, "--cost", "mine:gripped", "--out", "run"]
    assert cli.main([*run, "--optimizer", "random", "--episodes", "2", "--seed", "3"]) == 0
    record = runs.load_record(workdir / "run")
    costs = np.asarray(record.history.outcomes.cost)
    assert (costs >= 1).all() and (costs <= 2).all() and (costs < 2).any()


def test_changed_code_is_refused_with_what_changed(workdir, capsys):
    begun = [*OWN, "--test-trials", "0"]
    assert cli.main([*begun, "--episodes", "1", "--out", "run"]) == 0
    before = snapshot(workdir / "run")
    (workdir / "mine.py").write_text(MINE.replace("0.2 - trace", "0.3 - trace"))
    sys.modules.pop("mine")  # as in another process
    problems = refusal_of_command(*begun, "--episodes", "2", "--out", "run")
    assert problems[0] == ("conflict", "--out run") and ("conflict", "mine") in problems
    output = capsys.readouterr().err
    assert "-    return jnp.abs(0.2 - trace" in output
    assert "+    return jnp.abs(0.3 - trace" in output
    problems = refusal_of_command(*begun, "--cost", "mine:until_lost", "--out", "run")
    assert problems[0] == ("conflict", "--out run") and problems[-1] == ("conflict", "--cost")
    # What is the run's is not imported for whoever reads it, or asks for nothing.
    (workdir / "mine.py").unlink()
    sys.modules.pop("mine")
    assert refusal_of_command(*RUN, "--out", "run")
    assert "mine" not in sys.modules
    assert runs.load_record(workdir / "run") is not None
    assert snapshot(workdir / "run") == before


@pytest.mark.slow  # 29 s; quick: test_docs runs optimize --policy
def test_a_policy_is_searched_and_said_wherever_it_acts(workdir, capsys):
    """Its parameter is one of the design's; no command simulates its designs without it."""
    run = [*RUN, "--policy", "mine:Pull", "--optimizer", "random", "--episodes", "1"]
    assert cli.main([*run, "--out", "run"]) == 0
    assert "share" in capsys.readouterr().out
    the_scene, settings = runs.read_run(workdir / "run")
    assert settings.policy == "mine:Pull" and the_scene.control.parameter[0].name == "share"
    trials = ["--trials", "2", "--run", "run"]
    assert refusal_of_command("evaluate", *trials) == [("conflict", "--policy")]
    kept = []
    for share in ("0", "1"):
        design = ["--scene", str(TINY), "--engine", "mujoco", "--design", f"share={share}"]
        table = ["--out", f"{share}.csv"]
        cli.main(["evaluate", "--policy", "mine:Pull", *design, "--trials", "2", *table])
        kept.append((workdir / f"{share}.csv").read_text())
    assert kept[0] != kept[1]
    pair = [
        "compare",
        "run",
        str(shutil.copytree(workdir / "run", workdir / "copy")),
        "--trials",
        "2",
    ]
    assert refusal_of_command(*pair) == [("conflict", "--policy")]
    problems = refusal_of_command(*pair, "--policy", "mine:Pull", "mine:Narrow")
    assert problems == [("conflict", "--policy mine")]
    capsys.readouterr()
    assert cli.main(["compare", "run", "--policy", "mine:Pull", "--trials", "2"]) == 0
    output = capsys.readouterr().out
    assert "run with mine:Pull keeps " in output and "without keeps " in output
    assert "policy mine:Pull left the key frames in 2 of 2 grasps" in output
    assert "of the same 2 trials" in output
    (workdir / "a.toml").write_text(f'preset = "2d"\nscene = "{TINY}"\n[design]\nlength = 44\n')
    (workdir / "b.toml").write_text(f'preset = "2d"\nscene = "{TINY}"\n[design]\nlength = 100\n')
    files = ["compare", "a.toml", "b.toml", "--engine", "mujoco", "--trials", "2"]
    assert cli.main(files) == 0
    output = capsys.readouterr().out
    assert "a.toml keeps " in output and "b.toml keeps " in output and "difference: " in output
    first, other = (user_code.make_policy("mine:Pull", the_scene)[0] for _ in range(2))
    assert first is other  # its programs are compiled once


def test_a_dry_run_tells_of_a_policy_that_commands_kilopascals(workdir, capsys):
    """It is asked over the whole grasp, most of which begins with empty chambers."""
    dry = ["evaluate", "--scene", str(TINY), "--engine", "mujoco", "--dry-run", "--policy"]
    assert cli.main([*dry, "mine:Pull"]) == 0
    assert "while nothing moves" not in capsys.readouterr().out
    assert cli.main([*dry, "mine:late"]) == 0
    output = capsys.readouterr().out
    assert (
        "policy late: the highest pressure that it commands while nothing moves is 80 Pa" in output
    )
    assert "did you mean 80000?" in output


WRONG = {
    "--cost nobodys:low": "missing",
    "--cost mine:no_function": "type",
    "--cost mine:series": "user_code",
    "--cost broken:low": "user_code",
    "--policy mine.py:Pull": "syntax",
    "--cost ./mine.py:low": "syntax",
    "--optimizer ideas/mine.py:Climber": "syntax",
    "--policy mine:Narrow": "user_code",
    "--optimizer mine:Forgetful": "size",
    "--optimizer mine:low": "type",
}
"""Flags, and the kind of their problem."""


@pytest.mark.parametrize("flags", WRONG)
def test_what_is_wrong_is_said_before_anything_is_created(flags, workdir):
    (workdir / "broken.py").write_text("1 / 0\n")
    before = snapshot(workdir)
    flag, name = flags.split()
    [(code, key)] = refusal_of_command(*RUN, flag, name, "--episodes", "1", "--out", "run")
    assert (code, key.split()[0]) == (WRONG[flags], flag)
    sys.modules.pop("broken", None)
    assert {k: v for k, v in snapshot(workdir).items() if "__pycache__" not in str(k)} == before
