"""Hard cases 24 and 25: what refinement decides of late designs, and random designs of Table I."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from codesign_jax import rollout, scene
from codesign_jax.cost import particle_cost
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from codesign_jax.types import WARNINGS, Status
from tests.helpers import grasps
from tests.stability.bench import floats, refined
from tests.stability.table import Found, case

DESIGNS, TRIALS, TRIALS_IN_C = 40, 24, 6
"""MuJoCo C simulates 8 grasps a second: it is compared with over fewer trials."""
RANKS = 0.9
"""Bound of rank correlations, which was set before any was measured."""
LATE = np.array([[0.050, -0.055], [0.130, 0.060]])
"""Length and arm height [m] among which an optimisation ends: most designs there keep some of their
objects and lose others.  Of designs of the whole space most lose all of them and tie."""


@functools.cache
def evaluated(engine="structured", step=1.0, precision="float32", links=10, num_trials=TRIALS):
    """Whether late 2D designs keep their trials (design, trial), and the designs' costs."""
    loaded = scene.load("paper_spheres", overrides={"discretization": {"links": links}})
    base, unit = refined(loaded, step), np.random.default_rng(24).random((DESIGNS, 2))
    wide = precision == "float64" and engine == "structured"
    with floats(wide):
        dtype = jnp.float64 if wide else jnp.float32
        space = parameters.design_space(base.hand, "2d")
        params = jax.vmap(space.params)(jnp.asarray(LATE[0] + (LATE[1] - LATE[0]) * unit, dtype))
        # Drawn in float32 in either case: the same noise.
        with jax.enable_x64(False):
            drawn = rollout.sample_trials(base, jax.random.key(24), num_trials)
        trials = jax.tree.map(
            lambda v: jnp.asarray(np.asarray(v), v.dtype if v.dtype == jnp.int32 else dtype), drawn
        )
        chosen = make_engine(engine, base)
        result = jax.jit(lambda p, t: rollout.evaluate(base, chosen, p, t))(params, trials)
        return np.asarray(result.cost == 0), np.asarray(particle_cost(base, result))


def compared(measured, bound, one, two):
    kept, costs = [v[0] for v in (one, two)], [len(np.unique(v[1].round(3))) for v in (one, two)]
    note = f"{costs[0]} and {costs[1]} different costs, "
    note += f"{kept[0].mean():.3f} and {kept[1].mean():.3f} kept, "
    return Found(measured, bound, note + f"{np.mean(kept[0] != kept[1]):.1%} of the verdicts flip")


def ranks(one, two):
    return compared(stats.spearmanr(one[1], two[1])[0], RANKS, one, two)


def rates(one, two):
    """Difference of the success rates over the half width of its 95 % interval (paired)."""
    change = two[0].astype(float) - one[0]
    half = 1.96 * max(change.std() / np.sqrt(change.size), 1 / change.size)
    return compared(abs(change.mean()) / half, 1.0, one, two)


def in_c(precision):
    """MuJoCo C and the structured engine in the trials that the former simulates."""
    return [
        evaluated(engine, 1.0, width, num_trials=TRIALS_IN_C)
        for engine, width in (("mujoco", "float64"), ("structured", precision))
    ]


many = f"{DESIGNS} late designs, {TRIALS} trials"
fewer = f"decision of the structured engine, {DESIGNS} late designs, {TRIALS_IN_C} trials"
ours, once = {"precisions": ("float32",)}, {"steps": (1.0,)}
correlation, change = "rank correlation", "success rate: change over interval"
optimistic = (
    "the paper's time step flips verdicts, more to success than to failure; final tests belong to "
    "the preset reference (docs/accuracy.md)"
)
finer = (24, f"decision at a smaller step, {many}")
smaller = {"steps": (0.5, 0.25), **ours}


# The engine that ships at the paper's setting, and at another one.
@case(*finer, correlation, lower=True, **smaller)
def ranks_by_step(engine, step, precision):
    return ranks(evaluated(), evaluated(engine, step))


@case(*finer, change, fails=optimistic, **smaller)
def rates_by_step(engine, step, precision):
    return rates(evaluated(), evaluated(engine, step))


@case(24, f"decision at 20 links, {many}", correlation, lower=True, **once, **ours)
def ranks_by_links(engine, step, precision):
    return ranks(evaluated(), evaluated(links=20))


@case(24, f"decision at 20 links, {many}", change, **once, **ours)
def rates_by_links(engine, step, precision):
    return rates(evaluated(), evaluated(links=20))


@case(24, fewer, f"{correlation} with C", lower=True, **once)
def ranks_by_engine(engine, step, precision):
    return ranks(*in_c(precision))


@case(24, fewer, f"{change} with C", **once)
def rates_by_engine(engine, step, precision):
    return rates(*in_c(precision))


@case(24, f"the best design stays good, {many}", "its rank at h/4, of 40", **once, **ours)
def best_stays(engine, step, precision):
    (_, one), (_, two) = evaluated(), evaluated(step=0.25)
    best = one == one.min()
    # Several designs may share the lowest cost; the worst of them by the finer step counts.
    rank = (two < two[best].max()).sum() + 1
    return Found(float(rank), DESIGNS / 4, f"{best.sum()} share the lowest cost at h")


@case(
    25,
    "2,048 random designs of Table I, default scene",
    "share of numerical failures",
    **once,
    **ours,
)
def random_failures(engine, step, precision):
    """Of a million and of 114,688 such grasps 1e-6 and 9e-6 failed (docs/notes/stability.md)."""
    base = scene.load("paper")
    run = jax.jit(lambda p, t: rollout.simulate(base, make_engine(engine, base), p, t)[0].status)
    found = [np.asarray(run(*grasps.random_worlds(base, seed, 256))) for seed in range(8)]
    counted = np.concatenate(found) & ~int(WARNINGS)
    stuck = np.mean(counted == Status.STUCK)
    return Found(np.mean((counted & ~int(Status.STUCK)) != 0), 1e-4, f"{stuck:.2%} are STUCK")
