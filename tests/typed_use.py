"""A user's program as type checkers see it: `make types` checks it, nothing runs it.

The lines with `pyright: ignore` are mistakes: where one is not found, `make types` fails.
"""

# pyright: reportUnnecessaryTypeIgnoreComment=true, reportAttributeAccessIssue=true
# pyright: reportArgumentType=true

import jax
import numpy as np

from codesign_jax import (
    InputError,
    Params,
    Status,
    Task,
    codesign,
    parameters,
    rollout,
    scene,
    use_compilation_cache,
)


def find_a_design(steps: int) -> np.ndarray:
    use_compilation_cache()
    try:
        grasping = scene.load("paper", overrides={"discretization.links": 5})
    except InputError as error:
        raise SystemExit("; ".join(error.problems)) from error
    space = parameters.design_space(grasping.hand, "2d")
    task = Task(grasping, space, trials=3)
    optimizer = codesign.make_filter(space)
    state = optimizer.init(jax.random.key(0), space.default(), num_particles=10)
    for _ in range(steps):
        state, _info = task.episode(optimizer, state)
    hand: Params = space.params(state.particles[0])
    trials = rollout.sample_trials(grasping, jax.random.key(1), 6)
    batch = jax.tree.map(lambda v: v[None], hand)
    outcome = rollout.evaluate(grasping, task.engine, batch, trials)
    if Status(int(outcome.status[0, 0])) & Status.STUCK:
        return np.zeros(0)
    return space.in_units(np.asarray(state.particles[0]))


def mistakes() -> None:
    grasping = scene.load("paper")
    scene.load("paper", hand="tripod3")  # pyright: ignore[reportCallIssue]
    parameters.design_space(grasping)  # pyright: ignore[reportArgumentType]
    space = parameters.design_space(grasping.hand)
    space.from_unit(np.zeros(2))  # pyright: ignore[reportAttributeAccessIssue]
    codesign.make_filter(space, 0.05)  # pyright: ignore[reportCallIssue]
    scene.lod("paper")  # pyright: ignore[reportAttributeAccessIssue]
