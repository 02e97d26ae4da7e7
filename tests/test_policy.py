"""Policies in the loop: the open loop's bits, MuJoCo's poses, derivatives, what is refused."""

import dataclasses
import re
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, env, model, policy, rollout
from codesign_jax import scene as scenes
from codesign_jax.compiler import launch
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.model import morphology
from codesign_jax.model.layout import layout
from codesign_jax.report import charts
from codesign_jax.scene import parameters
from codesign_jax.types import Status
from tests.helpers import grasps
from tests.helpers.refusals import refusal

PAGE = Path(__file__).parents[1] / "docs" / "control.md"


def replay(carry, seen):
    return carry, seen.plan


def loop(scene, step, **attributes):
    """A control loop of a policy with attributes."""
    named = partial(step)
    for name, value in attributes.items():
        setattr(named, name, value)
    return policy.ControlLoop(make_engine("structured", scene), named)


SCENE = grasps.short_grasp()


@pytest.fixture(scope="module")
def simulate():
    """How four worlds end by the key frames, without and with recorded forces: one program."""
    engine = make_engine("structured", SCENE)

    @jax.jit
    def run(params, trials):
        ways = [{}, {"record_forces": True}]
        return [rollout.simulate(SCENE, engine, params, trials, **options) for options in ways]

    return run


@pytest.fixture(scope="module")
def worlds(simulate):
    """Four random worlds, and how they end."""
    inputs = grasps.random_worlds(SCENE, 1, 4)
    return inputs, *simulate(*inputs)


def test_recording_changes_no_bit_and_a_lost_object_has_no_forces(worlds):
    _, plain, (outcome, trace) = worlds
    jax.tree.map(np.testing.assert_array_equal, plain, (outcome, trace._replace(forces=None)))
    drawn = charts.grip(grasps.nth(trace.forces, 0), SCENE)["layers"]
    assert [line["name"] for line in drawn] == ["finger 0", "finger 1", "palm"]
    first = np.interp(
        drawn[0]["x"],
        SCENE.discretization.timestep * np.arange(SCENE.num_steps),
        trace.forces.grip[0, :, 0],
    )
    np.testing.assert_allclose(drawn[0]["y"], first, rtol=1e-3, atol=1e-6)  # four digits
    lost = np.asarray(outcome.lost_time)
    assert np.isfinite(lost).any()
    for world in np.flatnonzero(np.isfinite(lost)):
        after = round(lost[world] / SCENE.discretization.timestep)
        rest = jax.tree.map(lambda v, w=world, a=after: np.abs(v[w, a:]).max(), trace.forces)
        assert max(jax.tree.leaves(rest)) == 0


def test_who_replays_the_key_frames_simulates_the_open_loop(worlds):
    """To the bit: poses and pressures are the same numbers. The last period is a shorter one."""
    inputs, _, (outcome, trace) = worlds
    engine = loop(SCENE, replay, period=0.25)
    assert SCENE.num_steps % engine.steps

    @jax.jit
    def run(params, trials):
        simulated = rollout.simulate(SCENE, engine, params, trials, record_forces=True)
        return simulated, rollout.prepare(SCENE, params, trials)[1]

    (again, replayed), ctrl = run(*inputs)
    np.testing.assert_array_equal(replayed.ctrl, ctrl)
    both = (
        (outcome, trace._replace(forces=None)),
        (again, replayed._replace(ctrl=None, forces=None)),
    )
    jax.tree.map(np.testing.assert_array_equal, *both)
    # Of states that are recorded and that are found back from those after them, float32.
    for a, b in zip(*map(jax.tree.leaves, (replayed.forces, trace.forces)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_forces_are_found_for_policies_that_read_them(worlds, monkeypatch):
    """Others compile no kernel for them."""
    kernels = set()
    original = launch.describe

    def describe(inputs, outputs, kernel):
        kernels.add(kernel.origin)
        return original(inputs, outputs, kernel)

    def lighter(carry, seen):
        light = jnp.where(seen.forces.grip.sum() > 0, 0.5, 1.0)
        return carry, seen.plan._replace(pressure=light * seen.plan.pressure)

    monkeypatch.setattr(launch, "describe", describe)
    # The period of the environment below, whose kernels these are.
    for step, count in ((replay, 1), (lighter, 2)):
        kernels.clear()
        simulate = partial(rollout.simulate, SCENE, loop(SCENE, step, period=0.1))
        jax.eval_shape(simulate, *worlds[0])
        assert len(kernels) == count


def test_what_is_observed_is_where_mujoco_has_it(worlds):
    """After as many steps as a period above has."""
    scene = SCENE
    engine = make_engine("structured", SCENE)

    @jax.jit
    def look(params, trials):
        fields, ctrl = rollout.prepare(scene, params, trials)
        plan = rollout.prepare(scene, params, trials, loop(scene, replay))[1]
        recorded = engine.recording().rollout(fields, ctrl[:, :25])
        pushed = jax.tree.map(lambda v: v[:, -1], recorded.forces)
        world = policy.begin(scene, fields, plan)._replace(state=recorded.last)
        seen = policy.observe(scene, engine.observe(fields), fields, world, plan)
        seen = seen._replace(forces=engine.contacts(fields, recorded.last, ctrl[:, 24, 6:]))
        return recorded.last, fields, pushed, seen

    last, fields, pushed, seen = grasps.nth(look(*worlds[0]), ...)
    state = model.split(scene, last)
    lay = layout(scene)
    bodies = {"palm": 1, "object": lay.object}
    for w in range(len(last)):
        compiled = world_model(scene, grasps.nth(fields, w))
        data = mujoco.MjData(compiled)
        data.qpos = state.qpos[w]
        data.qvel = state.qvel[w]
        mujoco.mj_kinematics(compiled, data)
        mujoco.mj_comPos(compiled, data)
        mujoco.mj_comVel(compiled, data)
        for name, body in [*bodies.items(), ("link", lay.bodies)]:
            pose = jax.tree.map(lambda v, w=w: v[w], getattr(seen, name))
            # Chains of a few rotations in float32, over 0.2 m.
            np.testing.assert_allclose(pose.position, data.xpos[body], atol=2e-6)
            matrix = data.xmat[body].reshape(*np.shape(body), 3, 3)
            np.testing.assert_allclose(pose.rotation, matrix, atol=5e-6)
        speed = np.zeros(6)
        mujoco.mj_objectVelocity(compiled, data, mujoco.mjtObj.mjOBJ_BODY, lay.object, speed, 0)
        np.testing.assert_allclose(seen.object_velocity[w], speed[[3, 4, 5, 0, 1, 2]], atol=1e-5)
    # Of the step before, from the state after it: 1e-7 m/s are 1e-5 N.
    for a, b in zip(jax.tree.leaves(seen.forces), jax.tree.leaves(pushed), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)
    assert pushed.table.max() > 0.1
    np.testing.assert_allclose(seen.time, 0.25, rtol=1e-6)
    assert ([*scene.phase_ends][int(seen.phase[0])], len({*seen.phase})) == ("inflate", 1)
    np.testing.assert_allclose(seen.phase_time, 0.25 - scene.phases.approach, rtol=1e-5)


@pytest.mark.slow  # quick: the open loop's (test_engines), and that both have the same bits
def test_the_derivative_of_a_closed_loop_is_that_of_differences():
    """By a gain that its policy remembers, and acts on what it observes with."""
    scene = grasps.short_grasp()

    def react(gain, seen):
        pressure = seen.plan.pressure + gain * (1.0 + seen.joint[..., 0].mean(1))
        pose = seen.plan.pose.at[:, 0].add(gain[0] * 1e-6 * seen.object.position[0])
        return gain, policy.Command(pose, pressure)

    params, trial = grasps.hand_world(scene)

    def distance(gain):
        engine = loop(scene, react, init=lambda params: params.pressure * 0 + gain, period=0.1)
        return rollout.grasp(scene, engine, params, trial, steps=30).distance[-1]

    with jax.enable_x64(True):
        slope = float(jax.jit(jax.grad(distance))(5e3))
        above, below = (float(jax.jit(distance)(5e3 + d)) for d in (50.0, -50.0))
    assert abs(slope) > 1e-9
    # Differences of 1e-12 m, of contacts that bend over the 100 Pa.
    np.testing.assert_allclose(slope, (above - below) / 100.0, rtol=1e-4)


@pytest.mark.slow  # 7 s
def test_pressures_stay_within_what_the_walls_stand_and_what_is_no_number_fails_its_world(worlds):
    """And is told where it is, if nothing is traced."""
    params, trials = worlds[0]
    at_once = dataclasses.replace(SCENE.pneumatics, lag=0.0, rate=1e9)
    scene = dataclasses.replace(SCENE, pneumatics=at_once)

    def wild(carry, seen):
        pressure = jnp.where(seen.time > 0.2, jnp.nan, jnp.array([1e9, -1.0]))
        return carry, seen.plan._replace(pressure=pressure)

    engine = loop(scene, wild, period=0.1)
    run = jax.jit(partial(rollout.simulate, scene, engine))
    # The other two worlds start with a finger in the table.
    outcome, trace = grasps.nth(run(params, trials), slice(2))
    params = grasps.nth(params, slice(2))
    assert (np.asarray(outcome.status) & Status.NONFINITE).all()
    assert (np.asarray(outcome.bad_step) == 32).all()  # the supply passes it on a step later
    [(code, _)] = refusal(engine._refuse_nonfinite, trace.ctrl)  # as at the end of a rollout
    assert code == "range"
    ctrl = np.asarray(trace.ctrl)[:, :30]
    limit = scene.hand.pressure_limit.of(params.wall)
    top = np.maximum(limit, params.pressure)[:, :1]
    np.testing.assert_allclose(ctrl[:, 1:, 6], np.broadcast_to(top, (2, 29)), rtol=1e-6)
    assert (ctrl[..., 7] == 0).all()
    # The tip of a tapered finger stands less than its base.
    tapered = scenes.load("paper", hand_name="tapered4")
    space = parameters.design_space(tapered.hand, "full")
    design = jax.tree.map(lambda v: v[None], jax.jit(space.params)(space.default()))
    thin = design._replace(
        tip=design.tip._replace(wall=0.5 * design.wall), pressure=0.0 * design.pressure
    )
    none = jnp.zeros((1, 2, 6)), jnp.full((1, 2, tapered.num_fingers), 1e9)
    plan = control.Plan(*[None] * len(control.Plan._fields))._replace(
        pose=none[0], pressure=none[1], params=thin
    )
    pressures = policy.spread(tapered, policy.Command(*none), plan, of="policy").pressure
    want = morphology.pressure_limits(tapered.hand, thin)[:, None]
    np.testing.assert_allclose(pressures, np.broadcast_to(want, pressures.shape), rtol=1e-6)


@pytest.mark.slow  # quick: test_docs takes the policy, tests below step an environment
def test_the_page_s_policy_and_environment_do_what_they_say(monkeypatch):
    """Pressures rise where the object slips in the hand, and nowhere else."""
    # Without the air supply's lag a chamber has the pressure that is commanded.
    scene = grasps.short_grasp()
    effects = dataclasses.replace(scene.effects, pressure_dynamics=False)
    scene = dataclasses.replace(scene, effects=effects)
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.S | re.M)
    names = {}
    exec(blocks[0], names)
    firmer = names["Firmer"](scene)
    scene = policy.searched(scene, firmer)
    engine = policy.ControlLoop(make_engine("structured", scene), firmer)
    params, trials = grasps.random_worlds(scene, 3, 4)
    plan = rollout.prepare(scene, params, trials, engine)[1]
    ratios = {}
    run = jax.jit(partial(rollout.simulate, scene, engine))
    for gain in (0.0, 50.0):
        control = {"gain": jnp.full(4, gain)}
        trace = run(params._replace(control=control), trials)[1]
        ratios[gain] = np.asarray(trace.ctrl)[..., 6:] / np.maximum(plan.pressure, 1.0)
    inflated = round(scene.phases.inflate / scene.discretization.timestep)
    np.testing.assert_allclose(ratios[0.0][:, 1 + inflated :], 1.0, rtol=1e-5)
    np.testing.assert_allclose(ratios[50.0][:, :inflated], ratios[0.0][:, :inflated], rtol=1e-6)
    assert (ratios[50.0][:, -1] > 1.01).any() and (
        np.diff(ratios[50.0][:, inflated:], axis=1) >= -1e-5
    ).all()
    monkeypatch.setattr("codesign_jax.scene.load", lambda name: grasps.short_grasp())
    exec(blocks[1], names)
    assert names["state"].obs.shape == (8, names["grasping"].observation_size)


@pytest.mark.parametrize(
    ("step", "attributes", "problem"),
    [
        (lambda c, s: (c, s.plan._replace(pressure=jnp.ones(3))), {}, "size"),
        (lambda c, s: (c, s.plan._replace(pose=jnp.ones((4, 6)))), {}, "size"),
        (lambda c, s: (c, s.plan.pressure), {}, "type"),
        (lambda c, s: (s.time, s.plan), {}, "type"),
        (replay, {"period": 0.013}, "range"),
        (replay, {"period": 0.0}, "range"),
    ],
)
def test_what_is_no_policy_is_refused(step, attributes, problem):
    scene = grasps.short_grasp()

    def simulated():
        simulate = partial(rollout.grasp, scene, loop(scene, step, **attributes))
        return jax.eval_shape(simulate, *grasps.hand_world(scene))

    [(code, _)] = refusal(simulated)
    assert code == problem
    made = refusal(policy.ControlLoop, make_engine("structured", scene), "react")
    assert made == [("type", "policy")]
    assert refusal(policy.period_steps, SCENE, 0.033) == [("range", "period")]
    assert policy.period_steps(SCENE, 0.03) == 3


# --- environments: a grasp's actions make the trace of its controls, and trainers' wrappers run ---


gymnasium = pytest.importorskip("gymnasium")
vector = pytest.importorskip("codesign_jax.env.vector")


@pytest.fixture(scope="module")
def episode():
    """A batch of grasps that actions of zero let the key frames command, and all of its states."""
    params = grasps.hand_world(SCENE)[0]
    params = jax.tree.map(lambda v: np.asarray(v, np.float32), params)
    worlds = vector.VectorEnv(grasp := env.GraspEnv(SCENE, params, period=0.1), 4, seed=1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        worlds.step(worlds.action_space.sample())
    first, _ = worlds.reset(seed=2)
    assert worlds.observation_space.contains(first)
    states = [worlds._state]
    for k in range(grasp.episode_length):
        obs, _, ended, cut, info = worlds.step(np.zeros((4, 2), np.float32))
        states.append(worlds._state)
        assert ended.all() == (k == grasp.episode_length - 1) and not cut.any()
    assert set(info) == {"held", "distance"} and obs.dtype == np.float32
    return grasp, states, worlds


def test_actions_that_change_nothing_make_the_grasp_of_the_key_frames(episode, simulate):
    """Its end and its cost; what is held adds up to what the cost leaves."""
    grasp, states, _ = episode
    trials = states[0].data.trial
    params = jax.tree.map(lambda v: jnp.repeat(v[None], 4, 0), grasp.params)
    (outcome, trace), _ = simulate(params, trials)
    assert simulate._cache_size() == 1
    ends = [model.split(SCENE, s).qpos for s in (states[-1].data.world.state, trace.last)]
    # Two programs round model fields differently; contact and a solver that stops at a tolerance of
    # 1e-3 let that grow, to 3e-5.
    np.testing.assert_allclose(*ends, atol=1e-4)
    rewards = sum(state.reward for state in states)
    np.testing.assert_allclose(rewards, 1 - outcome.cost / SCENE.cost.maximum, atol=1e-6)
    assert [float(state.done.min()) for state in states[-2:]] == [0, 1]
    assert np.unique(trials.yaw).size == 4  # each its own


@pytest.fixture(scope="module")
def seen_at(episode):
    """What is observed in a state of the episode: one program."""
    grasp, states, _ = episode
    look = jax.jit(jax.vmap(grasp.seen))
    return lambda k: look(states[k].data)


def test_actions_scale_the_plan_from_nothing_to_twice_as_much(episode, seen_at):
    """Fingers that the plan keeps empty stay empty; no action says more than the ends do."""
    grasp, *_ = episode
    seen = grasps.nth(seen_at(2), 0)
    plan = np.array([[0.0, 5e4], [1e4, 6e4]], np.float32)  # of two time steps
    seen = seen._replace(plan=seen.plan._replace(pressure=plan))
    shares = {-3.0: 0.0, -1.0: 0.0, -0.5: 0.5, 0.0: 1.0, 0.5: 1.5, 1.0: 2.0, 3.0: 2.0}
    for action, share in shares.items():
        command = grasp.act(seen, jnp.full(2, action))
        np.testing.assert_allclose(command.pressure, share * plan, rtol=1e-6)
        np.testing.assert_array_equal(command.pose, seen.plan.pose)


def test_what_is_observed_is_what_a_hand_feels(episode, seen_at):
    grasp, states, _ = episode
    seen = seen_at(-1)
    felt = states[-1].obs
    np.testing.assert_allclose(felt[:, 0], SCENE.end_time, rtol=1e-6)
    np.testing.assert_allclose(felt[:, 2:4] * grasp.limit, seen.pressure, rtol=1e-5)
    assert felt.shape == (4, grasp.observation_size)
    blind = seen._replace(object=None, object_velocity=None)
    np.testing.assert_array_equal(*map(jax.vmap(grasp.observe), (blind, seen)))


@pytest.mark.slow  # quick: the vector environment, which begins ended grasps anew as well
def test_brax_trains_on_it_as_on_its_own(episode):
    """Its wrappers begin a grasp anew where one ended."""
    training = pytest.importorskip("brax.envs.wrappers.training")
    grasp = episode[0]
    wrapped = training.wrap(grasp, episode_length=grasp.episode_length)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    first = np.asarray(state.obs)
    step = jax.jit(wrapped.step)
    for _ in range(grasp.episode_length):
        state = step(state, jnp.zeros((4, 2)))
    assert (state.done == 1).all() and (state.info["truncation"] == 0).all()
    np.testing.assert_array_equal(state.obs, first)


def test_a_vector_environment_begins_ended_grasps_with_new_noise(episode):
    _, states, worlds = episode
    _, reward, ended, *_ = worlds.step(np.zeros((4, 2), np.float32))
    assert not ended.any() and (reward == 0).all()
    before = states[0].data.trial.yaw
    after = worlds._state.data.trial.yaw
    assert not (np.asarray(after) == np.asarray(before)).any()


def test_an_action_that_is_no_number_ends_its_grasp_alone(episode):
    """What is observed stays a number, so that a mean over observations does."""
    _, _, worlds = episode
    first, _ = worlds.reset(seed=5)
    actions = np.zeros((4, 2), np.float32)
    actions[0, 1] = np.nan
    obs, reward, ended, _, info = worlds.step(actions)
    assert list(ended) == [True, False, False, False] and reward[0] == 0
    np.testing.assert_array_equal(obs[0], first[0])
    assert np.isfinite(obs).all() and np.isfinite(info["distance"]).all()
    obs, _, ended, _, _ = worlds.step(np.zeros((4, 2)))
    assert np.isfinite(obs).all() and not ended.any()


NO_ENVIRONMENT = {
    "longer than a grasp": (lambda: env.GraspEnv(SCENE, period=10.0), ("order", "period")),
    "a step longer than a grasp": (lambda: env.GraspEnv(SCENE, period=0.61), ("order", "period")),
    "no whole number of steps": (lambda: env.GraspEnv(SCENE, period=0.033), ("range", "period")),
    "an engine without forces": (
        lambda: env.GraspEnv(SCENE, engine=cast(Any, SimpleNamespace(name="mujoco"))).observe(
            UNFELT
        ),
        ("unsupported", ""),
    ),
    "an action too short": (lambda: acted(env.GraspEnv(SCENE), 1), ("size", "an action")),
    "a number for an action": (lambda: acted(env.GraspEnv(SCENE)), ("size", "an action")),
    "actions of three": (lambda: acted(env.GraspEnv(SCENE), 3, 2), ("size", "an action")),
    "a number for a key": (lambda: Counted(SCENE).reset(0), ("type", "reset")),
    "numbers for a key": (lambda: Counted(SCENE).reset(jnp.zeros(2)), ("type", "reset")),
    "three keys": (
        lambda: Counted(SCENE).reset(jax.random.split(jax.random.key(0), 3)),
        ("size", "reset"),
    ),
    "two keys as their data": (
        lambda: Counted(SCENE).reset(jax.random.split(jax.random.PRNGKey(0), 2)),
        ("size", "reset"),
    ),
    "actions of two": (lambda: begun().step(np.zeros((2, 2))), ("size", "")),
    "actions too short": (lambda: begun().step(np.zeros((3, 1))), ("size", "")),
    "two seeds": (lambda: begun().reset(seed=[1, 2]), ("size", "seed")),
    "half a seed": (lambda: begun().reset(seed=[1, 2, 1.5]), ("type", "a seed")),
}
"""Calls, and kind and key of their problem."""


class Counted(env.GraspEnv):
    """Observes its trial and counts actions: what wrappers need, without a simulation."""

    def begin(self, trial):
        zero = jnp.zeros(())
        metrics = {"held": zero, "distance": zero}
        return env.State(jnp.int32(0), jnp.stack([trial.yaw, zero]), zero, zero, metrics)

    def step(self, state, action):
        done = state.data >= 2
        obs = state.obs.at[1].add(action.mean())
        return state.replace(
            data=state.data + 1, obs=obs, reward=obs[1], done=done.astype(obs.dtype)
        )


UNFELT: Any = SimpleNamespace(forces=None)
"""What is observed with an engine that tells no forces."""


def acted(grasp, *shape):
    """What a step makes of an action, without values."""
    state = jax.eval_shape(grasp.reset, jax.random.key(0))
    return jax.eval_shape(grasp.step, state, jax.ShapeDtypeStruct(shape, jnp.float32))


def begun():
    worlds = vector.VectorEnv(Counted(SCENE), 3)
    worlds.reset()
    return worlds


@pytest.mark.parametrize("problem", NO_ENVIRONMENT)
def test_what_is_no_environment_key_or_action_is_refused(problem):
    call, expected = NO_ENVIRONMENT[problem]
    assert refusal(call) == [expected]


def test_each_environment_draws_from_its_own_seed():
    """As Gymnasium's: a number is the first one's, and None draws on."""
    worlds = begun()
    first, _ = worlds.reset(seed=[7, 8, 9])
    assert len(np.unique(first[:, 0])) == 3
    for seed in (7, np.int64(7), 7 + 2**32, np.array([7, 8, 9]), (7, 8, 9)):
        np.testing.assert_array_equal(worlds.reset(seed=seed)[0], first)
    mixed, _ = worlds.reset(seed=[8, None, 8])
    assert mixed[0, 0] == mixed[2, 0] == first[1, 0] != mixed[1, 0]
    np.testing.assert_array_equal(vector.VectorEnv(Counted(SCENE), 3, seed=7).reset()[0], first)
    again, _ = worlds.reset(seed=-1)
    assert worlds.observation_space.contains(again)


@pytest.mark.parametrize("x64", [pytest.param(False, marks=pytest.mark.slow), True])
def test_single_environments_pass_gymnasium_s_check(x64):
    """And what is observed lies in its space whatever precision JAX has."""
    from gymnasium.utils import env_checker

    with jax.enable_x64(x64), warnings.catch_warnings():
        # Of spaces without ends, of an environment that is no registered one, and, of versions
        # before 1.2, of a check that is left out.
        warnings.filterwarnings("ignore", category=UserWarning, module="gymnasium")
        single = vector.SingleEnv(Counted(SCENE))
        with pytest.raises(gymnasium.error.ResetNeeded):
            single.step(np.zeros(2))
        env_checker.check_env(single, skip_render_check=True)
        assert single.observation_space.contains(single.reset(seed=3)[0])
        steps = [single.step(np.full(2, 0.5, np.float32)) for _ in range(3)]
        assert [(s[1], s[2]) for s in steps] == [(0.5, False), (1.0, False), (1.5, True)]
        worlds = vector.VectorEnv(Counted(SCENE), 2)
        obs, _ = worlds.reset(seed=0)
        assert worlds.observation_space.contains(obs)
        obs, reward, *_ = worlds.step(np.ones((2, 2), np.float32))
        assert worlds.observation_space.contains(obs) and reward.dtype == np.float64


def test_stable_baselines3_batches_as_its_own_vector_environments_do():
    """Ended grasps begin anew in the same step, and what was observed last is in the info."""
    pytest.importorskip("stable_baselines3")
    from codesign_jax.env.stable_baselines import BatchEnv

    worlds = BatchEnv(Counted(SCENE), 3, seed=7)
    first = worlds.reset()
    np.testing.assert_array_equal(first, vector.VectorEnv(Counted(SCENE), 3, seed=7).reset()[0])
    for k in range(3):
        obs, reward, done, infos = worlds.step(np.full((3, 2), 0.5, np.float32))
        np.testing.assert_allclose(reward, 0.5 * (k + 1))
        assert done.all() == (k == 2) and obs.dtype == np.float32
    np.testing.assert_allclose([info["terminal_observation"][1] for info in infos], 1.5)
    assert (obs[:, 1] == 0).all() and not (obs[:, 0] == first[:, 0]).any()
    worlds.seed(7)
    np.testing.assert_array_equal(worlds.reset(), first)
    assert worlds.env_is_wrapped(object) == [False] * 3 and worlds.get_attr("dt", [1]) == [0.05]


@pytest.mark.slow  # a program and PyTorch; quick: Gymnasium's check above
def test_stable_baselines3_trains_on_a_single_environment():
    """Its own check of environments, and PPO for two updates."""
    baselines = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env

    single = vector.SingleEnv(env.GraspEnv(SCENE, period=0.1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of PyTorch, and of networks on a GPU that are small
        check_env(single)
        model = baselines.PPO("MlpPolicy", single, n_steps=12, batch_size=12, seed=0, device="cpu")
        before = [p.clone() for p in model.policy.parameters()]
        model.learn(24)
    after = list(model.policy.parameters())
    assert model.num_timesteps == 24 and len(model.ep_info_buffer) == 4  # of 6 actions each
    assert all(p.isfinite().all() for p in after)
    assert any((p != q).any() for p, q in zip(before, after, strict=True))
