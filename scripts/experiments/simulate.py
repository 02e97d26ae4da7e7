"""The paper's experiments (Secs. VI.3 to VI.5): sizes, simulation, and the arrays that are kept.

Strategies are run folders, which `runs.optimize` fills in one batch: run r of every strategy has
the seed `seed + r`, and is what `codesign optimize --seed` makes of it.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from codesign_jax import batch, codesign, runs
from codesign_jax.devices import take
from codesign_jax.engines import make_engine
from codesign_jax.runs import Record
from codesign_jax.runs.progress import Meter
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.types import Status, failed
from scripts.shared import output, provenance


@dataclasses.dataclass(frozen=True)
class Strategies:
    """Optimisation strategies compared over many runs (Figs. 7 and 9).

    Attributes:
      name: Name of the experiment.
      preset: Design space of the hand.
      strategies: Names for `optimize.schedule`.
      runs: Runs of each strategy; run r has the root key `seed + r` in every strategy.
      particles: Particles of a run.
      episodes: Episodes of a run.
      trials: Trials of a particle in an episode.
      test_trials: Further trials of each final particle, a multiple of `trials`.
    """

    name: str
    preset: str
    strategies: tuple[str, ...]
    runs: int
    particles: int
    episodes: int
    trials: int
    test_trials: int

    def __post_init__(self) -> None:
        if self.test_trials % self.trials:
            raise ValueError(f"{self.test_trials=} must be a multiple of {self.trials=}")

    @property
    def rounds(self) -> int:
        """Rounds of `trials` trials that the final test takes."""
        return self.test_trials // self.trials

    @property
    def num_runs(self) -> int:
        return len(self.strategies) * self.runs

    @property
    def worlds(self) -> int:
        """Grasps of one episode, or of one round of the final test, over all runs."""
        return self.num_runs * self.particles * self.trials

    @property
    def grasps(self) -> int:
        """Grasps of episodes and final tests, without those that screen the seeds."""
        return self.worlds * (self.episodes + self.rounds)

    def first(self) -> tuple[str, ...]:
        """Domain in which each run starts: either one in turn, so equally often (Sec. VI.4)."""
        return tuple(("morphology", "control")[r % 2] for r in range(self.runs))


@dataclasses.dataclass(frozen=True)
class Landscape:
    """The cost on a grid over a design space of two parameters (Fig. 8).

    Attributes:
      name: Name of the experiment.
      preset: Design space of the hand, of two parameters.
      points: Grid points along either parameter, bounds included.
      trials: Trials of each point; every point meets the same ones.
    """

    name: str
    preset: str
    points: int
    trials: int

    @property
    def grasps(self) -> int:
        """Grasps of the experiment."""
        return self.points**2 * self.trials


SWITCHES = tuple(f"switch-{k}" for k in (1, 2, 4, 8, 16, 32))

_TWO = Strategies("2d", "2d", ("single", *SWITCHES, "concurrent"), 30, 10, 64, 6, 36)
_MANY = Strategies("23d", "paper-23d", ("single", "switch-1", "concurrent"), 30, 60, 128, 6, 72)
PAPER: dict[str, Strategies | Landscape] = {
    "2d": _TWO,
    "23d": _MANY,
    "landscape": Landscape("landscape", "2d", 60, 36),
}

PAPER_GRASPS = {"2d": 1_008_000, "landscape": 129_600, "23d": 4_536_000}
"""The paper's counts; its 1,000,800 in 2D is a digit swap, see docs/notes/results.md."""
TOTAL_GRASPS = sum(PAPER_GRASPS.values())

# Fewer runs and episodes of the paper's scene: figures that resemble the paper's in minutes.
SMALL: dict[str, Strategies | Landscape] = {
    "2d": Strategies("2d", "2d", ("single", "switch-2", "concurrent"), 6, 10, 24, 6, 36),
    "23d": Strategies("23d", "paper-23d", ("single", "concurrent"), 2, 20, 48, 6, 36),
    "landscape": Landscape("landscape", "2d", 16, 6),
}
# Two links and few runs: the whole path, mostly compiled programs; its figures mean nothing.
TINY: dict[str, Strategies | Landscape] = {
    "2d": Strategies("2d", "2d", ("single", "concurrent"), 2, 2, 2, 3, 3),
    "23d": Strategies("23d", "paper-23d", ("single", "concurrent"), 2, 2, 2, 3, 3),
    "landscape": Landscape("landscape", "2d", 2, 3),
}
SIZES = {"paper": (PAPER, ()), "small": (SMALL, ()), "tiny": (TINY, ("discretization.links=2",))}
"""Experiments by size, and what it changes in the scene."""


# --- strategies -----------------------------------------------------------------------------------

Arrays = dict[str, Any]
"""NumPy arrays by name."""


def folders(plan: Strategies, folder: Path, seed: int) -> dict[str, list[Path]]:
    numbers = range(seed, seed + plan.runs)
    return {name: [folder / name / f"seed-{n}" for n in numbers] for name in plan.strategies}


def plans(
    plan: Strategies, scene: Scene, engine: str, folder: Path, seed: int
) -> dict[Path, runs.Plan]:
    """Every run by its folder."""
    sizes = {n: getattr(plan, n) for n in ("particles", "trials", "episodes", "test_trials")}
    arguments = plan.preset, plan.strategies[0], plan.first()[0], engine
    base = runs.prepare(scene, runs.make_settings(*arguments, seed, **sizes))
    plans_by_folder = {}
    for name, run_folders in folders(plan, folder, seed).items():
        for r, (run_folder, first) in enumerate(zip(run_folders, plan.first(), strict=True)):
            changed = {"schedule": name, "first": first, "seed": seed + r}
            plans_by_folder[run_folder] = runs.variant(
                base, dataclasses.replace(base.settings, **changed)
            )
    return plans_by_folder


def gather(plan: Strategies, folder: Path, seed: int) -> Arrays | None:
    """What the runs of an experiment have so far.

    Returns:
      Arrays that begin with the axes (strategy, run): `particles`, and of the episodes that every
      run has `cost` (episode, particle), `trial_cost`, `status` and `lost_time` (episode, particle,
      trial); `test_cost` and `test_status` (particle, trial) if every run has its final test; and
      `seeds`, `seed_cost`, `seed_candidates` of the first strategy, which begin with the axis
      (run,). None if a run has not begun.
    """
    every = [
        [runs.load_record(run_folder) for run_folder in run_folders]
        for run_folders in folders(plan, folder, seed).values()
    ]
    records = [record for row in every for record in row if record is not None]
    if len(records) < plan.num_runs:
        return None
    done = min(record.done for record in records)
    tested = all(record.test is not None for record in records)
    rows = [_one(record, done, tested) for record in records]
    shape = (len(every), plan.runs)
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    arrays = {name: values.reshape(*shape, *values.shape[1:]) for name, values in arrays.items()}
    starts = [record.start for record in records[: plan.runs] if record.start is not None]
    names = {"design": "seeds", "cost": "seed_cost", "candidates": "seed_candidates"}
    return arrays | {new: np.array([getattr(s, old) for s in starts]) for old, new in names.items()}


def _one(record: Record, done: int, tested: bool) -> Arrays:
    history = record.history
    trials = record.history.outcomes
    arrays = {
        "particles": np.asarray(record.state.particles),
        "cost": history.cost[:done],
        "trial_cost": trials.cost[:done],
        "status": trials.status[:done].astype(np.uint8),
        "lost_time": trials.lost_time[:done],
    }
    if tested:
        assert record.test is not None
        test = {"cost": record.test.cost, "status": record.test.status}
        arrays |= {
            "test_cost": np.asarray(test["cost"]),
            "test_status": np.asarray(test["status"]).astype(np.uint8),
        }
    return arrays


# --- the landscape --------------------------------------------------------------------------------

STREAM_GRID = 0x67726964
"""Stream of the noise of the grid's trials ("grid")."""


def grid(space: DesignSpace, points: int) -> np.ndarray:
    """Returns the designs of a regular grid, shape (points, points, 2), first parameter first."""
    if space.num_parameters != 2:
        raise ValueError(f"a landscape needs two parameters, got {space.names}")
    axes = [np.linspace(a, b, points) for a, b in zip(space.low, space.high, strict=True)]
    designs = np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)
    return np.asarray(jax.vmap(jax.vmap(space.project))(designs))


def landscape(
    plan: Landscape,
    scene: Scene,
    engine: str,
    *,
    seed: int,
    chunk: int,
    devices: int | None,
    console: Console,
) -> Arrays:
    """Simulates every point in the same trials.

    Returns:
      `designs` (point, point, parameter), `trial_cost` and `status` (point, point, trial).
    """
    space = design_space(scene.hand, plan.preset)
    designs = grid(space, plan.points)
    flat = designs.reshape(-1, designs.shape[-1])
    count = len(take(devices))
    task = codesign.Task(scene, space, plan.trials, make_engine(engine, scene), devices=count)
    key = codesign.stream_key(jax.random.key(seed), STREAM_GRID)
    size = batch.size(len(flat), plan.trials, most=chunk, devices=count)
    with Meter(plan.name, plan.grasps, console) as meter:
        outcome = batch.evaluate(task, key, flat, size, meter.advance)
    shape = (plan.points, plan.points, plan.trials)
    arrays = {"trial_cost": outcome.cost, "status": outcome.status.astype(np.uint8)}
    arrays = {name: values.reshape(shape) for name, values in arrays.items()}
    return {"designs": designs, **arrays}


# --- what is kept ---------------------------------------------------------------------------------

BITS = tuple(s for s in Status if s and s is not Status.UNMOVED)
"""Status bits in the order of the `failed` arrays' last axis."""


def both_means(scene: Scene, cost: np.ndarray, status: np.ndarray) -> dict[str, np.ndarray]:
    """Mean cost over the last axis by either rule for failed trials; see `cost.particle_cost`."""
    good = ~failed(status)
    total = np.where(good, cost, 0).sum(-1, dtype=np.float64)
    count = good.sum(-1)
    exclude = np.where(count > 0, total / np.maximum(count, 1), scene.cost.maximum)
    worst = (total + scene.cost.maximum * (~good).sum(-1)) / good.shape[-1]
    return {"exclude": exclude.astype(np.float32), "worst": worst.astype(np.float32)}


def failures(status: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Counts of each status bit over some axes; the last axis is that of `BITS`."""
    return np.stack([((status & bit) != 0).sum(axes) for bit in BITS], -1).astype(np.int32)


def of_strategies(plan: Strategies, scene: Scene, space: DesignSpace, gathered: Arrays) -> Arrays:
    """What is kept of `gather`; docs/notes/results.md says what each array is."""
    cost = gathered["cost"]
    status = gathered["status"]
    quartiles = np.quantile(cost, [0.25, 0.5, 0.75], axis=-1).astype(np.float32)
    means = both_means(scene, gathered["trial_cost"], status)
    if "test_cost" in gathered:
        test = both_means(scene, gathered["test_cost"], gathered["test_status"])
        test_status = gathered["test_status"]
    else:  # not a number: the final test is not complete
        test = {
            rule: np.full(gathered["particles"].shape[:3], np.nan, np.float32) for rule in means
        }
        test_status = np.zeros((*gathered["particles"].shape[:3], 1), np.uint8)
    return {
        "strategies": np.array(plan.strategies),
        "first": np.array(plan.first()),
        "parameters": np.array(space.names),
        "seeds": gathered["seeds"],
        "seed_cost": gathered["seed_cost"],
        "seed_candidates": gathered["seed_candidates"],
        "mean": cost.mean(-1),
        "best": cost.min(-1),
        "quartiles": np.moveaxis(quartiles, 0, -1),
        "mean_exclude": means["exclude"].mean(-1),
        "mean_worst": means["worst"].mean(-1),
        "failed": failures(status, (3, 4)),
        # Enough for Fig. 6; half precision is finer than the costs' own steps matter in a plot.
        "particle_cost": cost[-1].astype(np.float16),
        "final_particles": gathered["particles"],
        "test_exclude": test["exclude"],
        "test_worst": test["worst"],
        "test_failed": failures(test_status, (3,)).astype(np.int16),
    }


def of_landscape(scene: Scene, space: DesignSpace, simulated: Arrays) -> Arrays:
    """What is kept of `landscape`."""
    cost = simulated["trial_cost"]
    status = simulated["status"]
    means = both_means(scene, cost, status)
    designs = space.in_units(simulated["designs"])
    return {
        "parameters": np.array(space.names),
        "units": np.array(space.units),
        "first_axis": designs[:, 0, 0],
        "second_axis": designs[0, :, 1],
        "exclude": means["exclude"],
        "worst": means["worst"],
        "success_ratio": ((cost == 0) & ~failed(status)).mean(-1),
        "failed": failures(status, (2,)).astype(np.int16),
    }


def settings_of(plan: Any, scene: Scene, engine: str, seed: int) -> dict[str, object]:
    """What determines the numbers of an experiment, beside code, versions and device."""
    return {
        "plan": dataclasses.asdict(plan),
        "scene": scene.name,
        "scene_sha256": provenance.scene_hash(scene),
        "failure": scene.cost.failure,
        "engine": engine,
        "seed": seed,
    }


def write(folder: Path, name: str, arrays: Arrays, notes: dict[str, object]) -> None:
    output.write_arrays(folder / f"{name}.npz", arrays)
    output.write_json(folder / f"{name}.json", notes, indent=2)
