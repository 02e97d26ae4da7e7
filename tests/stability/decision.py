"""Hard case 24: verdicts of late designs at smaller steps, at more links and in MuJoCo C."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from codesign_jax import rollout
from codesign_jax.cost import particle_cost
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from scripts.shared.statistics import two_way
from tests.stability.bench import floats, refined, scene_of
from tests.stability.table import Found, case

DESIGNS = 40
TRIALS = 24
TRIALS_IN_C = 6
"""MuJoCo C simulates 8 grasps a second: it is compared over fewer trials."""
RANKS = 0.77
"""Bound of rank correlations: a setting changes the order no more than other trials do.  Of 4,000
pairs of disjoint sets of 24 among 120 trials in `paper_spheres`, the costs of `standard` in one set
and in the other have a correlation of 0.885 in the median, and of 0.77 or more in 97.5 %."""
RANKS_IN_C = 0.95
"""The same bound between two engines, whose trials are the same: of 4,000 sets of 6 among 120
trials, a micrometre's move of the objects gives a correlation of 0.959 or more in 97.5 %."""
RESAMPLES = 2000
LATE = np.array([[0.050, -0.055], [0.130, 0.060]])
"""Length and arm height [m] among which an optimisation ends: most designs there keep some of their
objects and lose others.  Of designs of the whole space most lose all of them and tie."""


@functools.cache
def evaluated(name, engine="structured", step=1.0, precision="float32", links=10, trials=TRIALS):
    """Whether late 2D designs keep their trials (design, trial), and the designs' costs."""
    base = refined(scene_of(name, discretization__links=links), step)
    unit = np.random.default_rng(24).random((DESIGNS, 2))
    wide = precision == "float64" and engine == "structured"
    with floats(wide):
        dtype = jnp.float64 if wide else jnp.float32
        space = parameters.design_space(base.hand, "2d")
        values = LATE[0] + (LATE[1] - LATE[0]) * unit
        params = jax.vmap(space.params)(jnp.asarray(values, dtype))
        # Drawn in float32 in either case: the same noise.
        with jax.enable_x64(False):
            drawn = rollout.sample_trials(base, jax.random.key(24), trials)
        batch = jax.tree.map(
            lambda v: jnp.asarray(np.asarray(v), v.dtype if v.dtype == jnp.int32 else dtype), drawn
        )
        chosen = make_engine(engine, base)
        result = jax.jit(lambda p, t: rollout.evaluate(base, chosen, p, t))(params, batch)
        return np.asarray(result.cost == 0), np.asarray(particle_cost(base, result))


def compared(measured, bound, first, second):
    costs = [len(np.unique(v[1].round(3))) for v in (first, second)]
    flips = np.mean(first[0] != second[0])
    note = f"{costs[0]} and {costs[1]} different costs, "
    note += f"{first[0].mean():.3f} and {second[0].mean():.3f} kept, "
    return Found(measured, bound, note + f"{flips:.1%} of the verdicts flip")


def ranks(first, second, bound=RANKS):
    return compared(stats.spearmanr(first[1], second[1])[0], bound, first, second)


def ranks_in_c(first, second):
    return ranks(first, second, RANKS_IN_C)


def rates(first, second):
    """Difference of the success rates over the half width of its 95 % interval (paired).

    All designs share the trials, so that the interval is over designs and trials at once: 960
    grasps taken for independent ones would give an interval of half the width.
    """
    change = second[0].astype(float) - first[0]
    interval = two_way(lambda drawn: [drawn.mean()], change, resamples=RESAMPLES)[0]
    half = max((interval.high - interval.low) / 2, 1 / change.size)
    return compared(abs(change.mean()) / half, 1.0, first, second)


def best_rank(first, second):
    """Rank of the best design at h among the costs at h/4."""
    best = first[1] == first[1].min()
    # Several designs may share the lowest cost; the worst of them by the finer step counts.
    rank = (second[1] < second[1][best].max()).sum() + 1
    return Found(float(rank), DESIGNS / 4, f"{best.sum()} share the lowest cost at h")


def by_step(judge, name, engine, step, precision):
    return judge(evaluated(name), evaluated(name, engine, step))


def by_links(judge, name, engine, step, precision):
    return judge(evaluated(name), evaluated(name, links=20))


def by_engine(judge, engine, step, precision):
    """MuJoCo C and the structured engine in the trials that the former simulates."""
    mujoco = evaluated("paper_spheres", "mujoco", step, "float64", trials=TRIALS_IN_C)
    structured = evaluated("paper_spheres", "structured", step, precision, trials=TRIALS_IN_C)
    return judge(mujoco, structured)


def bound_to(judge, compare, *names):
    return functools.partial(compare, judge, *names)


CORRELATION = {"invariant": "rank correlation", "lower": True}
CHANGE = {"invariant": "success rate: change over interval"}
FINAL = {"invariant": "its rank at h/4, of 40"}
LINKS = {"steps": (1.0,), "precisions": ("float32",)}
SMALLER = {"steps": (0.5, 0.25), "precisions": ("float32",)}


def register(scene_name, suffix, title):
    """The comparisons of one scene over steps and links."""
    late = f"{DESIGNS} late designs, {TRIALS} trials{title}"
    finer = f"decision at a smaller step, {late}"
    more = f"decision at 20 links, {late}"
    stays = f"the best design stays good, {late}"

    def add(text, function, judge, name, options):
        measure = bound_to(judge, function, scene_name)
        case(24, text, name=f"{name}{suffix}", **options)(measure)

    add(finer, by_step, ranks, "ranks_by_step", CORRELATION | SMALLER)
    add(finer, by_step, rates, "rates_by_step", CHANGE | SMALLER)
    add(more, by_links, ranks, "ranks_by_links", CORRELATION | LINKS)
    add(more, by_links, rates, "rates_by_links", CHANGE | LINKS)

    def stay(engine, step, precision):
        return best_rank(evaluated(scene_name), evaluated(scene_name, step=0.25))

    case(24, stays, name=f"best_stays{suffix}", **FINAL, **LINKS)(stay)


register("paper_spheres", "", "")
register("paper", "_default", ", default scene")
FEWER = f"decision of the structured engine, {DESIGNS} late designs, {TRIALS_IN_C} trials"
with_c = {"steps": (1.0, 0.5)}
case(24, FEWER, "rank correlation with C", name="ranks_by_engine", lower=True, **with_c)(
    bound_to(ranks_in_c, by_engine)
)
case(24, FEWER, "success rate: change over interval with C", name="rates_by_engine", **with_c)(
    bound_to(rates, by_engine)
)
