"""Which of the constants that the paper leaves open fit its 2D figures: space-filling waves.

python -m scripts.calibration wave --sets 200 --out runs/wave.npz     # again to go on
python -m scripts.calibration score runs/wave.npz                     # writes runs/wave_scores.npz
python -m scripts.calibration wave --near runs/wave_scores.npz --sets 200 --out runs/wave2.npz
python -m scripts.calibration score runs/wave2.npz --set hand.material=dragon_skin_10
python -m scripts.calibration tables                                  # of docs/calibration.md

A wave simulates a coarse landscape of the 2D experiment for each set of constants, all sets by one
compiled program; what is measured, the fingers' silicone, is the scene's and does not vary.  A
second wave draws its sets around the best of a first one.  The score runs the particle filter on
these landscapes and compares them with the paper's text: implausibility is the distance to a
statement in standard deviations, and a set beyond `CUTOFF` of any of them is ruled out.  The 23D
experiment is held out.  --set changes what the scene holds fixed, in `wave` and `score` alike.
docs/data/calibration has the scores of two waves by each law of the fingers' sections.
"""

import dataclasses
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.stats import fisher_exact, qmc

from codesign_jax import codesign, rollout, scene
from codesign_jax.batch import LIMIT
from codesign_jax.codesign import stream_key
from codesign_jax.engines import Engine, make_engine
from codesign_jax.optimize import OptimizerState, ParticleFilter, candidates, schedule
from codesign_jax.scene import (
    InputError,
    Scene,
    keypaths,
    parameters,
    section_law,
    section_numbers,
)
from codesign_jax.scene import constants as checks
from codesign_jax.scene.beams import strain_pressure
from codesign_jax.scene.hand import Hand
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import failed
from scripts.shared import output, provenance

CUTOFF = 3.0
"""Implausibility above which a set is ruled out: three standard deviations, whatever the
distribution as long as it has one peak (Pukelsheim 1994)."""
CLEARANCE = 0.002
"""Smallest gap between the sections of a pair of fingers at a spread of zero [m]."""
DATA = Path("docs/data/calibration")
LAWS = {
    "chamber": "chamber",
    "elements": "elements, thread outside",
    "elements_inside": "elements, thread on the chamber",
}
"""Laws of the section: file names of their scores, second wave, and what tables call them."""
PAGE = Path("docs/calibration.md")
BEST = 10
NEAR = 0.15
"""Sets of a first wave around which a second one draws, and how far, as a share of each range."""


class Open(NamedTuple):
    """Range of a constant that the paper does not give; evidence: docs/notes/calibration.md."""

    unit: str
    low: float
    high: float
    log: bool = False


# `base_x` is the distance of the base points from the plane between the two pairs of fingers,
# `pair_gap` that of the two base points of a pair, `half_size` that of the cuboid, with which all
# objects grow.  Damping of the wrist follows its stiffness at the file's damping ratio.
OPEN = {
    "tilt": Open("deg", 30, 90),
    "base_x": Open("mm", 15, 45),
    "pair_gap": Open("mm", 22, 40),
    "zero_height": Open("mm", 0, 80),
    "width": Open("mm", 15, 30),
    "lateral": Open("", 0.29, 1),
    "torsion": Open("", 1, 3),
    "half_size": Open("mm", 20, 40),
    "mass": Open("g", 20, 300, log=True),
    # The interval of a pneumatic gripper's friction ratio, docs/reality.md.
    "friction": Open("", 0.77, 1.09),
    "table_friction": Open("", 0.2, 0.6),
    "wrist_linear": Open("N/m", 100, 2000, log=True),
    "wrist_angular": Open("N m/rad", 1, 20, log=True),
    "shake_amplitude": Open("deg", 10, 45),
    "shake_frequency": Open("Hz", 0.5, 2),
    "normal_stiffness": Open("kN/m", 1, 20, log=True),
    "friction_ratio": Open("", 3, 100, log=True),
    "cost_maximum": Open("", 2.2, 4),
}


WORDS = {
    "tilt": "tilt of the fingers",
    "base_x": "base points to the palm's middle plane",
    "pair_gap": "gap between the two fingers of a side",
    "zero_height": "height of the palm at `arm_z` = 0",
    "width": "width of a finger",
    "lateral": "lateral stiffness ×",
    "torsion": "torsional stiffness ×",
    "friction": "friction of the hand",
    "table_friction": "friction of the table",
    "wrist_linear": "wrist, linear",
    "wrist_angular": "wrist, angular",
    "shake_amplitude": "shaking, amplitude",
    "shake_frequency": "shaking, frequency",
}
"""What the page calls the constants that its waves varied."""


def space_filling(count: int, seed: int) -> np.ndarray:
    """The first points of a scrambled Sobol sequence in the unit cube, shape (set, constant)."""
    with warnings.catch_warnings():
        # Balanced at powers of two only; other numbers are as even as the sequence allows.
        warnings.filterwarnings("ignore", "The balance properties", UserWarning)
        # SciPy 1.15 renamed the argument and takes the old name as well.
        sequence = qmc.Sobol(len(OPEN), seed=np.random.default_rng(seed))  # type: ignore
        return sequence.random(count)


def near_best(units: np.ndarray, distances: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Sets around the best of a wave, each within `NEAR` of one of them, shape (set, constant).

    The best have the smallest of their largest distances.  More sets do not change earlier ones.

    Args:
      units: Sets of the wave in the unit cube, shape (n, constant).
      distances: Their implausibility by each statement, shape (n, statement).
    """
    best = units[np.argsort(distances.max(-1), kind="stable")[:BEST]]
    proposals = best[np.arange(count) % len(best)] + NEAR * (2 * space_filling(count, seed) - 1)
    return 1 - np.abs(1 - np.abs(proposals))  # reflected at both ends of a range


def values(units: np.ndarray) -> dict[str, np.ndarray]:
    """Values in the units of `OPEN`, shape (set,), of points of the unit cube, (set, constant)."""
    constants = {}
    for (name, o), u in zip(OPEN.items(), np.asarray(units, float).T, strict=True):
        low, high = (np.log([o.low, o.high]) if o.log else np.array([o.low, o.high])) + 0.0
        constants[name] = np.exp(low + u * (high - low)) if o.log else low + u * (high - low)
    u = np.asarray(units, float)[:, list(OPEN).index("pair_gap")]
    least = least_gap(constants["width"])
    return constants | {"pair_gap": least + u * (OPEN["pair_gap"].high - least)}


def least_gap(width: Any) -> Any:
    """Smallest gap of a pair of fingers of a width [mm]."""
    return np.maximum(OPEN["pair_gap"].low, width + 1e3 * CLEARANCE)


def own_set(the_scene: Scene) -> np.ndarray:
    """The scene's own constants as a point of the unit cube, outside of it if beyond a range."""
    hand = the_scene.hand
    shape = the_scene.objects.object[0]
    c = the_scene.contact
    x, y = np.abs(hand.finger[0].base or (0.0, 0.0))
    width = 1e3 * hand.section.width
    material = hand.material
    wrist = hand.wrist
    arm = the_scene.arm
    constants = {
        "tilt": hand.finger[0].tilt,
        "base_x": 1e3 * x,
        "pair_gap": 2e3 * y,
        "zero_height": 1e3 * arm.zero_height,
        "width": width,
        "lateral": material.lateral_factor,
        "torsion": material.torsion_factor,
        "half_size": 1e3 * shape.half_sizes[0],
        "mass": 1e3 * shape.mass,
        "friction": shape.friction,
        "table_friction": the_scene.objects.table.friction,
        "wrist_linear": wrist.linear_stiffness,
        "wrist_angular": wrist.angular_stiffness,
        "shake_amplitude": arm.shake_amplitude,
        "shake_frequency": arm.shake_frequency,
        "normal_stiffness": 1e-3 * c.normal_stiffness,
        "friction_ratio": c.friction_ratio,
        "cost_maximum": the_scene.cost.maximum,
    }
    ranges = OPEN | {"pair_gap": OPEN["pair_gap"]._replace(low=float(least_gap(width)))}
    scaled = {k: np.log if o.log else np.asarray for k, o in ranges.items()}
    ends = {k: (scaled[k](o.low), scaled[k](o.high)) for k, o in ranges.items()}
    return np.array([(scaled[k](constants[k]) - a) / (b - a) for k, (a, b) in ends.items()])


def _hand_of_sets(hand: Hand, v: Mapping[str, np.ndarray]) -> Hand:
    """The hand with the numbers of sets."""
    x = 1e-3 * v["base_x"]
    y = 0.5e-3 * v["pair_gap"]
    wrist = hand.wrist
    linear = v["wrist_linear"]
    angular = v["wrist_angular"]
    return replace(
        hand,
        finger=tuple(
            replace(f, tilt=v["tilt"], base=(right * x, front * y))
            for f in hand.finger
            for right, front in [np.sign(f.base or (0.0, 0.0))]
        ),
        material=replace(
            hand.material,
            lateral_factor=v["lateral"],
            torsion_factor=v["torsion"],
        ),
        section=replace(hand.section, width=1e-3 * v["width"]),
        wrist=replace(
            wrist,
            linear_stiffness=linear,
            angular_stiffness=angular,
            linear_damping=wrist.linear_damping * np.sqrt(linear / wrist.linear_stiffness),
            angular_damping=wrist.angular_damping * np.sqrt(angular / wrist.angular_stiffness),
        ),
    )


def numbers(the_scene: Scene, chosen: Mapping[str, np.ndarray]) -> Scene:
    """The scene with the numbers of sets in it: leaves of shape () or (set,)."""
    if any(f.base is None for f in the_scene.hand.finger):
        raise InputError(["calibration moves base points; give each finger a base"])
    c = the_scene
    v = chosen
    factor = 1e-3 * v["half_size"] / c.objects.object[0].half_sizes[0]
    shapes = tuple(
        replace(
            shape,
            size=tuple(factor * s for s in shape.size or ()),
            mass=1e-3 * v["mass"],
            friction=v["friction"],
        )
        for shape in c.objects.object
    )
    table = replace(c.objects.table, friction=v["table_friction"])
    c = replace(
        c,
        hand=_hand_of_sets(c.hand, v),
        objects=replace(c.objects, object=shapes, table=table),
        arm=replace(
            c.arm,
            zero_height=1e-3 * v["zero_height"],
            shake_amplitude=v["shake_amplitude"],
            shake_frequency=v["shake_frequency"],
        ),
        contact=replace(
            c.contact,
            normal_stiffness=1e3 * v["normal_stiffness"],
            friction_ratio=v["friction_ratio"],
        ),
        cost=replace(c.cost, maximum=v["cost_maximum"]),
    )
    checks.check(c)
    return c


def load_scores(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Sets in the unit cube, (set, constant), and distances, (set, statement), of a score's file.

    A constant of the file that is not in `OPEN` any more is left out.

    Raises:
      InputError: If the file has not all constants of `OPEN`.
    """
    with np.load(path, allow_pickle=False) as file:
        units = file["units"]
        distances = file["distances"]
        names = [*file["names"]]
    if missing := [name for name in OPEN if name not in names]:
        raise InputError([f"{path} has no constant {', '.join(missing)}"])
    return units[:, [names.index(name) for name in OPEN]], distances


def remaining_sets(path: Path = DATA / "chamber.npz", *, strain: bool = True) -> np.ndarray:
    """Sets that no statement ruled out, of a file of scores, in the unit cube, (set, constant).

    Without `strain` the statement about free strains, the last one, does not count.
    """
    units, distances = load_scores(path)
    counted = distances if strain else distances[:, :-1]
    return units[(counted <= CUTOFF).all(-1)]


def laws_table() -> str:
    """How many sets each law leaves, with Fisher's exact test against the law "chamber"."""
    rows = [["law", "wave", "sets", "left", "p", "left without the free strain", "p"]]
    for suffix, wave in (("_first", "first"), ("", "second")):
        reference: dict[bool, tuple[int, int]] = {}
        for law, words in LAWS.items():
            path = DATA / f"{law}{suffix}.npz"
            total = len(load_scores(path)[0])
            row = [words, wave, str(total)]
            for strain in (True, False):
                left = len(remaining_sets(path, strain=strain))
                counts = left, total - left
                _, chance = fisher_exact([counts, reference.setdefault(strain, counts)])
                row += [str(left), "–" if law == "chamber" else f"{chance:.1g}"]
            rows.append(row)
    return output.markdown(rows)


def _rounded(value: float) -> str:
    return f"{float(f'{value:.3g}'):g}"


def constants_table(the_scene: Scene) -> str:
    """The scene's constants and the ranges of the sets that two laws leave, 5 to 95 %."""
    left = [
        values(remaining_sets()),
        values(remaining_sets(DATA / "chamber_first.npz", strain=False)),
        values(remaining_sets(DATA / "elements_first.npz", strain=False)),
    ]
    heads = ["`chamber`, second wave", "`chamber`, first wave", "`elements`, first wave"]
    counts = [f"{h}: {len(v['tilt'])} sets" for h, v in zip(heads, left, strict=True)]
    rows = [["constant", "default", *counts]]
    defaults = values(own_set(the_scene)[None])
    for name, words in WORDS.items():
        spans = []
        for law_values in left:
            low, high = np.percentile(law_values[name], [5, 95])
            spans.append("–" if low == high else f"{_rounded(low)} to {_rounded(high)}")
        unit = f" [{OPEN[name].unit}]" if OPEN[name].unit else ""
        rows.append([words + unit, f"{defaults[name][0]:.3g}", *spans])
    return output.markdown(rows)


# --- a wave ---------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Wave:
    """Landscapes of sets: all designs of a set meet the same trials, of the key (seed, set)."""

    scene: Scene
    engine: Engine
    space: DesignSpace
    units: np.ndarray
    points: int = 12
    trials: int = 6
    seed: int = 0
    chunk: int = LIMIT

    def designs(self) -> np.ndarray:
        """The grid, shape (points, points, 2), first parameter first."""
        low = self.space.low
        high = self.space.high
        axes = [np.linspace(a, b, self.points) for a, b in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)

    def costs(self, done: list[np.ndarray], say: Callable[[list[np.ndarray]], Any]) -> np.ndarray:
        """Costs of every trial, (set, point, point, trial), NaN where it failed.

        `done` are those of the first sets; `say` is told all costs so far after each call.
        """
        flat = self.designs().reshape(-1, 2)
        each = max(1, self.chunk // (len(flat) * self.trials))
        every = numbers(self.scene, values(self.units))
        root = jax.random.key(self.seed)

        @jax.jit
        def simulate(sets: Scene, keys: jax.Array) -> Any:
            draw = lambda key: rollout.sample_trials(self.scene, key, self.trials)  # noqa: E731
            set_, design, trial = jnp.indices((each, len(flat), self.trials)).reshape(3, -1)
            params = jax.tree.map(lambda v: v[design], jax.vmap(self.space.params)(flat))
            drawn = jax.tree.map(lambda v: v[set_, trial], jax.vmap(draw)(keys))
            scenes = jax.tree.map(lambda v: v[set_] if jnp.ndim(v) else v, sets)
            return rollout.simulate(scenes, self.engine, params, drawn)[0]

        for first in range(sum(len(d) for d in done), len(self.units), each):
            # Filled up with the last set, so that every call has the compiled size.
            index = np.minimum(np.arange(first, first + each), len(self.units) - 1)
            part = lambda v, i=index: jnp.asarray(v[i] if np.ndim(v) else v, jnp.float32)  # noqa: E731
            keys = jax.vmap(lambda i: stream_key(root, STREAM_WAVE, i))(jnp.asarray(index))
            outcomes = jax.tree.map(np.asarray, simulate(jax.tree.map(part, every), keys))
            cost = np.where(failed(outcomes.status), np.nan, outcomes.cost)
            cost = cost.reshape(each, self.points, self.points, self.trials)
            done.append(cost[: len(self.units) - first].astype(np.float32))
            say(done)
        return np.concatenate(done)


STREAM_WAVE = 0x67726964
"""Stream of the noise of a wave's trials ("grid")."""


# --- the particle filter on a landscape -----------------------------------------------------------

STRATEGIES = ("single", "switch-4", "concurrent")
RUNS = 30
PARTICLES = 10
EPISODES = 64
TRIALS = 6
TEST = 42
CANDIDATES = 64
SCREEN = 1_000_000
FINAL = 1_000_001
"""Seed candidates of a run; numbers of the draws that belong to no episode."""


def on_landscapes(space: DesignSpace, shapes: int = 3) -> Callable[..., Any]:
    """Returns the function (costs, shared) -> (mean cost of episodes, success) of `STRATEGIES`.

    A trial of a design is one of the landscape's, drawn with the object whose turn it is, its cost
    interpolated between the grid's points.  Costs have shape (set, point, point, trial), results
    (set, strategy, run, episode) and (set, strategy, run); `shared`: particles of an episode meet
    the same trials.
    """
    optimizer: ParticleFilter = codesign.make_filter(space)
    domain = np.asarray(space.is_morphology)
    first = ["morphology" if r % 2 == 0 else "control" for r in range(RUNS)]
    masks = jnp.array([[schedule(s, domain, EPISODES, f) for f in first] for s in STRATEGIES])  # type: ignore[arg-type]
    low, high = (jnp.asarray(v) for v in (optimizer.space.low, optimizer.space.high))

    def trial_cost(landscape: jax.Array, design: jax.Array, trial: jax.Array) -> jax.Array:
        points = jnp.array(landscape.shape[:2])
        position = (design - low) / (high - low) * (points - 1)
        i, j = corner = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, points - 2)
        a, b = position - corner
        at = (i, j, trial)
        square = jax.lax.dynamic_slice(landscape, at, (2, 2, 1))[..., 0]
        return jnp.array([1 - a, a]) @ square @ jnp.array([1 - b, b])

    def costs(landscape, particles, key, number, shared, trials):
        base_key = stream_key(key, 0x6C616E64, jnp.asarray(number, jnp.int32))
        keys = jax.vmap(lambda i: jax.random.fold_in(base_key, i))(
            jnp.where(shared, 0, jnp.arange(len(particles)))
        )

        def draw(key: jax.Array) -> jax.Array:
            turn = jax.random.randint(key, (trials,), 0, landscape.shape[-1] // shapes)
            return turn * shapes + jnp.arange(trials) % shapes

        every = jax.vmap(jax.vmap(trial_cost, (None, None, 0)), (None, 0, 0))
        return every(landscape, particles, jax.vmap(draw)(keys)).mean(-1)

    def run(landscape, key, mask, shared):
        drawn = candidates(key, optimizer.space, np.arange(CANDIDATES))
        poor = costs(landscape, drawn, key, SCREEN, shared, TRIALS) > codesign.SEED_COST
        start = OptimizerState(jnp.tile(drawn[jnp.argmax(poor)], (PARTICLES, 1)), jnp.int32(0), key)

        def episode(state: OptimizerState, mask: jax.Array) -> tuple[OptimizerState, jax.Array]:
            population = optimizer.ask(state, mask)
            cost = costs(landscape, population, key, state.episode, shared, TRIALS)
            new, info = optimizer.tell(state, population, cost)
            return new, info.mean_cost

        end, mean = jax.lax.scan(episode, start, mask)
        test = costs(landscape, end.particles, key, FINAL, shared, TEST)
        return mean, (test < codesign.SUCCESS_COST).any()

    over_runs = jax.vmap(run, (None, 0, 0, None))
    over_sets = jax.vmap(jax.vmap(over_runs, (None, None, 0, None)), (0, None, None, None))
    keys = jax.vmap(jax.random.key)(np.arange(RUNS))
    return jax.jit(lambda landscapes, shared: over_sets(landscapes, keys, masks, shared))


def episodes_to_converge(mean: np.ndarray, *, stays: bool) -> np.ndarray:
    """Episodes until the mean cost stays below 1, or first is below it; or infinity."""
    below = np.asarray(mean) < codesign.CONVERGED_COST
    last = below.shape[-1]
    if stays:
        count = last - np.minimum.accumulate(below[..., ::-1], -1).sum(-1) + 1.0
    else:
        count = np.argmax(below, -1) + np.where(below.any(-1), 1.0, np.inf)
    return np.where(count > last, np.inf, count)


# --- the paper's statements -----------------------------------------------------------------------


def saddle(cost: np.ndarray) -> float:
    """Highest cost above which all ways between two regions of low cost rise, or 0."""
    apart = 0.0
    for height in np.arange(0.5, 3.01, 0.125):
        basins, count = ndimage.label(cost < height, structure=np.ones((3, 3)))  # type: ignore[misc]
        low = [((cost < 0.5) & (basins == k)).mean() >= 0.01 for k in range(1, count + 1)]
        apart = float(height) if sum(low) > 1 else apart
    return apart


def free_strain(chosen: Mapping[str, np.ndarray], hand: Hand, *, neo_hookean: bool) -> np.ndarray:
    """Largest wall strain of a free finger within Table I's bounds and pressure limit, (set,)."""
    of = {p.name: p for p in hand.parameter}
    height, wall = (1e-3 * np.linspace(of[n].low, of[n].high, 11) for n in ("height", "wall"))
    height = height[:, None]
    if hand.section.law == "elements":
        limits = hand.pressure_limit.per_wall * wall
        largest = []
        for width in 1e-3 * chosen["width"]:
            numbers = section_numbers.of_hand(hand, height, wall, width, np.inf)
            largest.append((height * section_law.free_bend(numbers, limits)).max())
        return np.array(largest)
    strain = np.linspace(0.05, 4.0, 400)  # between which a law that softens is straight enough
    limit = np.broadcast_to(hand.pressure_limit.per_wall * wall, (len(height), len(wall)))
    largest = []
    for width in 1e-3 * chosen["width"]:
        beam = {"width": width, "shear_modulus": hand.material.shear_modulus}
        every = strain[:, None, None]
        pressure = strain_pressure(every, height, wall, **beam, neo_hookean=neo_hookean)
        pairs = zip(limit.ravel(), pressure.reshape(len(strain), -1).T, strict=True)
        largest.append(
            max(
                np.interp(highest, largest_pressures, strain)
                for highest, largest_pressures in pairs
            )
        )
    return np.array(largest)


def score(
    costs: np.ndarray, chosen: Mapping[str, np.ndarray], the_scene: Scene
) -> dict[str, np.ndarray]:
    """Implausibility of each set by each of the paper's statements, by name, shape (set,).

    Costs are those of `Wave.costs`, `chosen` the sets' values.
    """
    maximum = chosen["cost_maximum"]
    space = parameters.design_space(the_scene.hand, "2d")
    good = np.isfinite(costs)
    mean = np.where(good, costs, 0).sum(-1) / np.maximum(good.sum(-1), 1)
    mean = np.where(good.any(-1), mean, maximum[:, None, None])
    filled = np.where(good, costs, mean[..., None]).astype(np.float32)
    run = on_landscapes(space)
    efforts = {}
    success: dict[str, np.ndarray] = {}
    for noise in ("shared", "own"):
        parts = [run(filled[i : i + 32], noise == "shared") for i in range(0, len(filled), 32)]
        every, kept = (np.concatenate([np.asarray(p[k]) for p in parts]) for k in (0, 1))
        for k, name in enumerate(STRATEGIES):
            success[name] = kept[:, k].mean(-1)  # of "own", the last one
            for kind in ("first", "stays"):
                episodes = episodes_to_converge(every[:, k], stays=kind == "stays")
                middle = np.median(np.minimum(episodes, EPISODES + 1), axis=-1)
                efforts[name, kind, noise] = np.log(PARTICLES * TRIALS * middle)

    def at_least(value: Any, least: Any, deviation: float) -> np.ndarray:
        return np.maximum(least - value, 0.0) / deviation

    single, some, all_at_once = (success[s] for s in STRATEGIES)
    # Deviations: of the logarithm of a median of 30 runs 0.25; of a difference of two shares of 30
    # runs sqrt(2 p (1 - p) / 30) = 0.12; of a mean of six trials near a cost of 1 0.3; of a share
    # of 0.15 on a grid of 144 points 0.03; of a strain of 1.5 the 4 % that its law may err by
    # (docs/measurements.md).  That success "quickly increases" is read as 12 of 30.
    readings = [np.abs(v - np.log(420.0)) for k, v in efforts.items() if k[0] == "concurrent"]
    late = []
    for kind in ("first", "stays"):
        times = [efforts[s, kind, "own"] for s in reversed(STRATEGIES)]
        gaps = [np.maximum(a - b, 0) for a, b in zip(times, times[1:], strict=False)]
        late.append(np.max(gaps, 0))
    heights = np.array([saddle(m) for m in mean])
    law = bool(the_scene.effects.neo_hookean)
    strains = free_strain(chosen, the_scene.hand, neo_hookean=law)
    return {
        "420 simulations": np.min(readings, 0) / 0.25,
        "two regions": at_least(heights, 1.0, 0.3),
        "solutions": at_least((mean < 0.01).mean((1, 2)), 0.01, 0.005),
        "poor seeds": at_least((mean > 2.0).mean((1, 2)), 0.15, 0.03),
        "single is poor": np.maximum(
            at_least(0.5 * all_at_once, single, 0.12), at_least(all_at_once - single, 0.4, 0.12)
        ),
        "concurrent succeeds": at_least(all_at_once, np.maximum(single, some), 0.12),
        "switching is faster": np.min(late, 0) / 0.25,
        # Table I limits pressures "to avoid excessive curvature".
        "free strain": at_least(-strains, -1.5, 0.04 * 1.5),
    }


def summary(units: np.ndarray, distances: Mapping[str, np.ndarray], count: int = 5) -> list[str]:
    """Lines about a score: what each statement rules out, what is left, and the best sets."""
    every = np.stack([*distances.values()], -1)
    kept = (every <= CUTOFF).all(-1)
    constants = values(units)
    lines = [f"{kept.sum()} of {len(units)} sets are not ruled out"]
    lines += [f"  {name}: rules out {(d > CUTOFF).sum()}" for name, d in distances.items()]
    best = np.argsort(every.max(-1), kind="stable")[:count]
    lines += ["constant: 5 to 95 % of the sets that are left | the best sets"]
    for name, o in OPEN.items():
        span = "–"
        if kept.any():
            low, high = np.percentile(constants[name][kept], [5, 95])
            span = f"{low:.3g} to {high:.3g}"
        shown = ", ".join(f"{v:.3g}" for v in constants[name][best])
        lines.append(f"  {name} {o.unit}: {span} | {shown}")
    worst = [list(distances)[k] for k in every[best].argmax(-1)]
    numbers = (f"{d:.2f} ({name})" for d, name in zip(every[best].max(-1), worst, strict=True))
    return [*lines, f"  largest distance: {', '.join(numbers)}"]


def score_file(path: Path, the_scene: Scene) -> int:
    """Scores what a wave has simulated so far, beside its file."""
    with np.load(path, allow_pickle=False) as file:
        units = file["units"]
        costs = file["costs"]
    units = units[: len(costs)]
    scores = score(costs, values(units), the_scene)
    out = path.with_name(f"{path.stem}_scores.npz")
    distances = np.stack([*scores.values()], -1)
    output.write_arrays(out, {"units": units, "distances": distances, "names": [*OPEN]})
    print("\n".join([str(out), *summary(units, scores)]))
    return 0


def sets_of(args: Any, the_scene: Scene) -> np.ndarray:
    """The sets of a wave: around the best of another one or filling the ranges, then the own."""
    if args.near:
        units = near_best(*load_scores(args.near), args.sets, args.seed)
    else:
        units = space_filling(args.sets, args.seed)
    scene_set = own_set(the_scene)
    fixed = [list(OPEN).index(name) for name in args.fix]
    units[:, fixed] = scene_set[fixed]
    return np.concatenate([units, *[scene_set[None]] * args.scene_sets])


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("command", choices=("wave", "score", "tables"))
    parser.add_argument("file", type=Path, nargs="?", help="file of a wave to score")
    parser.add_argument("--out", type=Path, default=Path("runs/wave.npz"))
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    near = "scores of a wave around whose best sets these are drawn"
    parser.add_argument("--near", type=Path, metavar="SCORES", help=near)
    fix = "constants that every set has of the scene"
    parser.add_argument("--fix", nargs="+", default=[], choices=OPEN, metavar="NAME", help=fix)
    text = "how often the scene's own set comes behind them, each time in other trials"
    parser.add_argument("--own", dest="scene_sets", type=int, default=0, metavar="TIMES", help=text)
    parser.add_argument("--chunk", type=int, default=LIMIT, help="most worlds of a call")
    changed = "values of the scene, hand and objects by key path"
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help=changed)
    args = parser.parse_args()
    try:
        the_scene = scene.load("paper", overrides=keypaths.parse(args.set))
        if args.command == "tables":
            output.fill(PAGE, laws_table(), "calibration_laws")
            output.fill(PAGE, constants_table(the_scene), "calibration_constants")
            return 0
        if args.command == "score":
            return score_file(args.file or args.out, the_scene)
        units = sets_of(args, the_scene)
        done = []
        if args.out.exists():
            done = [load_costs(args.out, units)]
    except InputError as error:
        parser.error(str(error))
    space = parameters.design_space(the_scene.hand, "2d")
    engine = make_engine("structured", the_scene)
    wave = Wave(the_scene, engine, space, units, seed=args.seed, chunk=args.chunk)

    def keep(parts: list[np.ndarray]) -> None:
        output.write_arrays(args.out, {"units": units, "costs": np.concatenate(parts)})
        print(f"{sum(len(p) for p in parts)} of {len(units)} sets", flush=True)

    wave.costs(done, keep)
    notes = provenance.results(args.commit) | {"scene_sha256": provenance.scene_hash(the_scene)}
    output.write_json(args.out.with_suffix(".json"), notes)
    return 0


def load_costs(path: Path, units: np.ndarray) -> np.ndarray:
    """Costs of the first sets of a wave, of the file that it has written so far.

    Raises:
      InputError: If they are costs of other sets.
    """
    with np.load(path, allow_pickle=False) as file:
        costs = file["costs"]
        stored = file["units"]
    count = len(costs)
    if stored.shape[1:] != units.shape[1:] or not np.array_equal(stored[:count], units[:count]):
        raise InputError([f"{path} has other sets; choose another --out or remove it"])
    return costs


if __name__ == "__main__":
    sys.exit(main())
